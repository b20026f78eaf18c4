"""Every block of commands, settings and Python in the documents is run, or says why it cannot be.

What a reader does is done in a folder of its own, block after block of a page. A comment above a
block says what holds for it alone:

    <!-- not run: REASON -->       its commands are only compared with the existing options
    <!-- slow: REASON -->          the same; `python -m tests.documents` runs it
    <!-- file: NAME -->            it is the content of this file, which later blocks use
    <!-- part of: KIND -->         it is a part of a file of settings
    <!-- ends with: CODE -->       exit code of its last command
    <!-- in: FOLDER -->            the files of this folder lie where its commands are run

An adapter is replaced by the device model, which takes no time. In the output `...` matches
anything, and times are not compared.
"""
