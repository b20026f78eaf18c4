"""A whole line on virtual time: stories of units and operators, judged by what each unit bears.

    python -m tests.campaigns.line_world --steps 100000 --jobs 2 --seed 4000
    python -m tests.campaigns.line_world --replay "line sockets=1 ; unit label=1 ; ..."

The whole station runs: `Station` with its line, supervisor and records, `work_on` of each socket's
process with its runs, all in greenlets on simulated buses. No real clock is read, so that a seed
draws the same story, and a story takes the same course, each time and in each process. With
`--ledger FILE` a campaign goes on with the stories that an earlier one has not played.

# A story

Clauses, one a line or parted by " ; ". First what there is:

    line sockets=2 recipe=writes    writes, plain, held, bicycle, wmc or obc
    unit label=1 number=none application=old pace=fast answers=true
    person name=jo source=page      who has the same source shares a scanner or a page;
                                    mounted: the scanners at the sockets

Then acts with their times. People are honest: an act that no honest person would do then, or
for which nothing is there, is skipped, so that any part of a story is a story.

    @3.0 put unit=1 socket=A        pull unit=1
    @4.0 card by=jo unit=1          the card of the socket that the unit is in (or socket=B)
    @4.5 label by=jo unit=1
    @5.0 cancel by=jo               free by=jo socket=A; abort by=jo socket=A; resume by=jo
    @6.0 look                       only time passes
    @7.0 sleep unit=1 seconds=3     the unit neither hears nor sends; its supply stays on
    @7.0 dip socket=A seconds=0.5   the supply of a socket fails
    @7.0 stall socket=A seconds=1   the process of a socket stalls
    @7.0 worker socket=A            it dies
    @7.0 unplug socket=A seconds=1  its adapter is away
    @7.0 station seconds=2          the station dies, and is started again
    @7.0 power seconds=2            nothing has power: units, the computer, the station
    @7.0 disk seconds=4             nothing can be saved

At its end a careful person brings each unit home, by acts of the same kinds. A step of the campaign
is an act that was done.

# What has to hold

Kinds of violations, by what is true when there is none:

    FALSE PASS      a PASS is of the unit with that paper label, which was the only one in its run,
                    holds the image, and its number where the recipe writes it
    NUMBER          no unit reports a number that is neither its label's nor what it had
    TOUCHED         a unit with a number of its own is not flashed or written under another label
    GREEN           a green tile is of the unit in its socket, and of a PASS that is saved
    LOST            each PASS that was shown is in the records
    ACCUSED         a unit that nothing has disturbed is not taken for another one
    BLAMED          one that was pulled before its flash is not recorded as FAIL
    CANCELLED       a label that was cancelled begins no run
    ABORTED         a run ends as aborted only where somebody aborted it
    UNIDENTIFIED    a unit without application is flashed only with the card of its socket
    TRUSTED         after UNIT_CHANGED, a label passes only with a new flash
    FORGOTTEN       a run that a dead station left is shown when it runs again
    CRASH           neither the station nor a process ends or hangs by a bug
    STUCK           from every state scans lead each unit to the end of a run

# What is counted

The summary names the steps, stories, scans and runs, how the runs ended, and as "undetectable" the
exchanges that cannot be detected: those of `undetectable`, and where a target cannot be asked
(recipes wmc and obc) those between its card and its label, between the first reset of a run and its
first update command, and after the end of its transfer. Anything else of the kinds above is a
violation; it is shrunk to a story of one line.
"""
