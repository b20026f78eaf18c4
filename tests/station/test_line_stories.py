"""Stories of a whole line on virtual time, of the campaign `tests.campaigns.line_world`: which unit
a label ends on when units and people change places, and an oracle that finds what it should.
"""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Callable
from hashlib import sha256
from itertools import count, islice
from pathlib import Path
from random import Random
from subprocess import run
from typing import Final

import pytest

from flasher.mock.table import BootloaderState
from flasher.simulate.planting import swapped
from flasher.station import runs
from flasher.station.codes import Code
from flasher.station.continuity import Continuity
from flasher.station.presence import Presence, TargetWatcher
from flasher.station.records.model import StepName
from flasher.station.socket import Socket
from flasher.station.unit_run import UnitRun
from flasher.station.unit_steps import UnitSteps
from flasher.station.unit_target import StepFailedError
from tests.campaigns import line_world
from tests.campaigns.line_bugs import ACTS, read_bugs
from tests.campaigns.line_world import undetectable
from tests.campaigns.line_world.draw import setup_of
from tests.campaigns.line_world.play import Played, draw, play, shrink
from tests.campaigns.line_world.promises import Violation
from tests.campaigns.line_world.stories import CLAUSES, Story
from tests.campaigns.line_world.world import STUCK
from tests.loops import sample

pytestmark = pytest.mark.slow

SAMPLE = sample(2, 8)
SAMPLE_ACTS = 24
PULLED_IN_ITS_FLASH = (
    "line sockets=2 ; unit label=1 ; unit label=3 pace=slow ; person name=jo ;"
    " @3.0 card by=jo unit=3 socket=B ; @3.1 label by=jo unit=3 ; @3.2 put unit=3 socket=B ;"
    " @6.0 pull unit=3 ; @9.0 put unit=1 socket=B"
)
CARD_HERE_LABEL_THERE = (
    "line sockets=2 ; unit label=2 ; unit label=3 ; person name=jo source=jo ;"
    " person name=al source=al ; @1.0 put unit=3 socket=B ; @2.0 card by=jo unit=3 ;"
    " @4.0 label by=al unit=2"
)
PASSED_AND_EXCHANGED = (
    "line sockets=2 ; unit label=1 ; unit label=2 ; person name=jo ; @3.0 put unit=1 socket=A ;"
    " @7.0 card by=jo unit=1 ; @8.0 label by=jo unit=1 ; @14.0 pull unit=1 ;"
    " @14.3 put unit=2 socket=A"
)
NOT_OBSERVED_AFTER_ITS_FLASH = (
    "line sockets=1 ; unit label=1 ; person name=jo ; @3.0 put unit=1 socket=A ;"
    " @8.0 card by=jo unit=1 ; @9.0 label by=jo unit=1 ; @9.9 stall socket=A seconds=1.0"
)
STORIES = {
    "pulled in its flash": PULLED_IN_ITS_FLASH,
    "card here, label there": CARD_HERE_LABEL_THERE,
    "passed and exchanged": PASSED_AND_EXCHANGED,
    "label here, card there": (
        "line sockets=2 ; unit label=3 ; unit label=4 ; person name=jo source=jo ;"
        " person name=al ; @3.0 label by=jo unit=4 ; @6.0 put unit=3 socket=B ;"
        " @7.0 card by=al unit=3"
    ),
    "another number comes into the flash": (
        "line sockets=2 recipe=plain ; unit label=1 number=other ; unit label=3 pace=slow ;"
        " person name=jo ; @3.0 put unit=3 socket=A ; @4.0 card by=jo unit=3 ;"
        " @4.5 label by=jo unit=3 ; @6.0 pull unit=3 ; @6.3 put unit=1 socket=A"
    ),
    "the number of the unit before": (
        "line sockets=2 ; unit label=2 number=own ; unit label=3 ; person name=jo ;"
        " @3.0 put unit=2 socket=A ; @4.75 pull unit=2 ; @5.0 put unit=3 socket=A ;"
        " @5.1 label by=jo unit=2"
    ),
    "exchanged after the card": (
        "line sockets=2 recipe=plain ; unit label=1 ; unit label=2 ; person name=al ;"
        " @3.0 put unit=2 socket=B ; @13.0 card by=al unit=2 ; @14.0 pull unit=2 ;"
        " @14.3 put unit=1 socket=B ; @16.0 label by=al unit=2"
    ),
    "exchanged just before the label": (
        "line sockets=1 recipe=plain ; unit label=1 ; unit label=2 ; person name=jo ;"
        " @3.0 put unit=2 socket=A ; @3.1 card by=jo unit=2 ; @6.35 pull unit=2 ;"
        " @6.6 put unit=1 socket=A ; @6.64 label by=jo unit=2"
    ),
    "exchanged while it is identified": (
        "line sockets=2 ; unit label=1 ; unit label=3 ; person name=jo ; @3.0 put unit=1 socket=B ;"
        " @12.0 card by=jo unit=1 ; @13.0 label by=jo unit=1 ; @13.1 pull unit=1 ;"
        " @13.5 put unit=3 socket=B"
    ),
    "exchanged just before the reset": (
        "line sockets=1 ; unit label=1 ; unit label=3 pace=slow ; person name=jo ;"
        " @3.0 put unit=3 socket=A ; @5.0 label by=jo unit=3 ; @5.4 pull unit=3 ;"
        " @5.7 put unit=1 socket=A"
    ),
    "a second burst before it is identified": (
        "line sockets=3 ; unit label=1 ; unit label=4 ; person name=jo ;"
        " @3.0 card by=jo unit=4 socket=C ; @5.0 label by=jo unit=4 ; @5.5 put unit=4 socket=C ;"
        " @6.0 pull unit=4 ; @7.0 put unit=1 socket=C"
    ),
    "exchanged where identify ends": (
        "line sockets=3 recipe=plain ; unit label=3 ; unit label=4 number=own ; person name=al ;"
        " @3.0 card by=al unit=3 socket=C ; @3.5 label by=al unit=3 ; @3.7 put unit=3 socket=C ;"
        " @4.25 pull unit=3 ; @4.5 put unit=4 socket=C"
    ),
    "a bootloader for an application": (
        "line sockets=2 recipe=plain ; unit label=1 ; unit label=3 application=none ;"
        " person name=al ; @3.0 put unit=3 socket=B ; @3.1 card by=al unit=3 ;"
        " @4.0 label by=al unit=3 ; @4.5 pull unit=3 ; @5.0 put unit=1 socket=B"
    ),
    "a bootloader for an application, fast": (
        "line sockets=1 recipe=plain ; unit label=2 ; unit label=4 application=none ;"
        " person name=jo ; @3.0 put unit=4 socket=A ; @5.0 card by=jo unit=4 ;"
        " @15.45 pull unit=4 ; @15.7 put unit=2 socket=A ; @18.0 label by=jo unit=4"
    ),
    "an application for a bootloader that sleeps": (
        "line sockets=1 ; unit label=3 application=none ; unit label=4 ; person name=jo ;"
        " @3.0 put unit=3 socket=A ; @3.5 card by=jo unit=3 socket=A ; @4.5 label by=jo unit=3 ;"
        " @5.0 sleep unit=3 seconds=4.0 ; @7.85 pull unit=3 ; @8.1 put unit=4 socket=A"
    ),
    "its label again, and cancelled": (
        "line sockets=2 ; unit label=1 ; person name=jo ; @3.0 put unit=1 socket=B ;"
        " @7.0 card by=jo unit=1 ; @8.0 label by=jo unit=1 ; @10.5 pull unit=1 ;"
        " @14.0 label by=jo unit=1 ; @14.5 cancel by=jo ; @20.0 free by=jo socket=A"
    ),
    "an application for a bootloader that erases": (
        "line sockets=1 ; unit label=1 ; unit label=2 application=none pace=slow ; person name=jo ;"
        " @3.0 put unit=2 socket=A ; @4.0 card by=jo unit=2 ; @6.0 label by=jo unit=2 ;"
        " @7.5 pull unit=2 ; @8.0 put unit=1 socket=A"
    ),
    "a process that stalls": (
        "line sockets=2 ; unit label=1 ; person name=jo source=jo ; @3.0 put unit=1 socket=B ;"
        " @16.0 stall socket=B seconds=4.0 ; @18.0 card by=jo unit=1 ; @19.0 label by=jo unit=1"
    ),
    "a process that stalls beside a bootloader": (
        "line sockets=2 ; unit label=1 application=none ; person name=jo source=jo ;"
        " @3.0 put unit=1 socket=B ; @16.0 stall socket=B seconds=4.0 ; @18.0 card by=jo unit=1 ;"
        " @19.0 label by=jo unit=1"
    ),
    "bootloaders that change places while a process stalls": (
        "line sockets=2 ; unit label=1 application=none ; unit label=3 application=none ;"
        " person name=mo ; @3.0 put unit=3 socket=A ; @8.0 card by=mo unit=3 ;"
        " @9.0 stall socket=A seconds=2.0 ; @9.3 pull unit=3 ; @10.0 put unit=1 socket=A ;"
        " @12.0 label by=mo unit=3"
    ),
    "a unit that is pulled before it confirms its image": (
        "line sockets=1 ; unit label=2 pace=slow ; unit label=3 application=new ; person name=al ;"
        " @3.0 put unit=2 socket=A ; @6.6 label by=al unit=2 ; @8.7 pull unit=2 ;"
        " @9.0 put unit=3 socket=A"
    ),
    "a unit that is pulled as its run ends": (
        "line sockets=1 ; unit label=1 ; person name=jo source=jo ; @0.0 put unit=1 socket=A ;"
        " @0.83 label by=jo unit=1 ; @2.21 pull unit=1"
    ),
    "a unit that is pulled soon after its run": (
        "line sockets=3 ; unit label=2 pace=slow ; person name=jo source=jo ;"
        " @3.0 put unit=2 socket=B ; @9.0 card by=jo unit=2 ; @10.0 label by=jo unit=2 ;"
        " @10.5 pull unit=2 ; @58.0 put unit=2 socket=C ; @125.5 card by=jo unit=2 ;"
        " @126.0 label by=jo unit=2"
    ),
    "a unit that is pulled as its application starts, after it was put where the power was off": (
        "line sockets=1 ; unit label=3 ; person name=jo ; @3.0 dip socket=A seconds=4.0 ;"
        " @3.1 put unit=3 socket=A ; @7.0 card by=jo unit=3 ; @7.4 label by=jo unit=3 ;"
        " @7.5 pull unit=3"
    ),
    "a unit that gets its power after its label and reports another number": (
        "line sockets=1 recipe=held ; unit label=2 number=other ; person name=jo ; person name=al ;"
        " @3.0 card by=al unit=2 socket=A ; @3.2 label by=al unit=2 ; @21.3 put unit=2 socket=A ;"
        " @24.0 pull unit=2 ; @88.0 put unit=2 socket=A ; @88.1 card by=jo unit=2 socket=A ;"
        " @88.5 dip socket=A seconds=2.0 ; @89.0 label by=jo unit=2"
    ),
    "a unit that is pulled in the run of one which runs in another socket by then": (
        "line sockets=3 ; unit label=1 number=own ; unit label=6 pace=slow ;"
        " person name=jo source=jo ; @44.5 put unit=1 socket=C ; @45.0 label by=jo unit=1 ;"
        " @45.9 pull unit=1 ; @46.2 put unit=6 socket=C ; @46.5 put unit=1 socket=B ;"
        " @48.0 pull unit=6"
    ),
    "a unit that is pulled while the adapter is away": (
        "line sockets=1 ; unit label=1 ; person name=jo ; @3.0 put unit=1 socket=A ;"
        " @7.0 label by=jo unit=1 ; @12.0 unplug socket=A seconds=0.5 ; @12.2 pull unit=1 ;"
        " @20.0 look"
    ),
    "a label that waits beside the verdict of the unit before": (
        "line sockets=1 ; unit label=1 ; unit label=2 ; unit label=3 ; person name=mo source=mo ;"
        " @3.0 put unit=2 socket=A ; @3.5 label by=mo unit=2 ; @3.8 pull unit=2 ;"
        " @6.1 label by=mo unit=3 ; @10.8 put unit=1 socket=A"
    ),
    "a bootloader that is pulled as its flash begins": (
        "line sockets=2 ; unit label=1 ; unit label=2 ; unit label=3 pace=slow ;"
        " person name=jo source=mounted ; person name=al source=al ; @1.68 put unit=3 socket=A ;"
        " @1.71 card by=al unit=3 ; @2.09 label by=al unit=3 ; @4.14 pull unit=3 ;"
        " @4.44 put unit=1 socket=A ; @6.53 pull unit=1 ; @10.23 put unit=2 socket=A ;"
        " @10.35 label by=jo unit=2 ; @10.62 put unit=3 socket=B ; @13.05 label by=jo unit=3 ;"
        " @14.12 pull unit=2 ; @14.22 pull unit=3 ; @17.72 put unit=2 socket=B"
    ),
    "a card that is dropped as the label is scanned": (
        "line sockets=3 recipe=plain ; unit label=2 ; unit label=5 ; person name=jo ;"
        " @3.0 put unit=2 socket=C ; @3.1 put unit=5 socket=A ; @6.5 card by=jo unit=2 ;"
        " @22.0 label by=jo unit=2 ; @29.0 card by=jo unit=5"
    ),
    "two cards at one page, of which one was dropped just now": (
        "line sockets=2 recipe=wmc ; unit label=1 ; unit label=2 ; person name=jo ;"
        " person name=mo ; @8.67 put unit=1 socket=B ; @13.44 put unit=2 socket=A ;"
        " @13.48 card by=mo unit=1 ; @14.5 worker socket=B ; @14.86 card by=jo unit=2 ;"
        " @15.09 label by=mo unit=1"
    ),
    "a card of two people that the label of one has used up": (
        "line sockets=1 recipe=bicycle ; unit label=2 number=own application=none ;"
        " unit label=3 pace=slow ; unit label=4 number=maker application=new pace=slow ;"
        " person name=jo ; person name=al ; @2.2 put unit=3 socket=A ; @3.28 card by=jo unit=3 ;"
        " @3.29 label by=jo unit=3 ; @5.85 pull unit=3 ; @6.15 put unit=4 socket=A ;"
        " @8.0 card by=jo unit=4 ; @9.1 card by=al unit=4 ; @9.6 label by=al unit=4 ;"
        " @11.6 pull unit=4 ; @12.7 put unit=2 socket=A ; @14.26 card by=al unit=2 ;"
        " @23.0 label by=jo unit=4 ; @24.5 look"
    ),
    "the adapter is away when a unit is missed": (
        "line sockets=1 recipe=bicycle ; unit label=3 ; person name=jo source=jo ;"
        " @0.0 put unit=3 socket=A ; @3.5 label by=jo unit=3 ; @24.1 pull unit=3 ;"
        " @26.0 unplug socket=A seconds=4.0 ; @29.0 look"
    ),
    "the adapter is away when a pulled unit is asked whether it is there": (
        "line sockets=1 recipe=bicycle ; unit label=1 ; person name=jo ; @3.0 put unit=1 socket=A ;"
        " @6.0 card by=jo unit=1 ; @8.0 label by=jo unit=1 ; @8.5 pull unit=1 ;"
        " @16.0 unplug socket=A seconds=4.0"
    ),
    "exchanged before anything of it was received after an outage": (
        "line sockets=1 ; unit label=2 ; unit label=3 ; person name=jo ;"
        " @17.751062 unplug socket=A seconds=0.05 ; @18.583766 put unit=2 socket=A ;"
        " @18.974001 card by=jo unit=2 socket=A ; @18.974001 pull unit=2 ;"
        " @19.274001 put unit=3 socket=A ; @19.359158 label by=jo unit=2"
    ),
    "a new flash after an interrupted one": (
        "line sockets=1 ; unit label=1 pace=slow ; person name=jo source=jo ;"
        " @36.875 label by=jo unit=1 ; @43.122 put unit=1 socket=A ; @43.665 pull unit=1 ;"
        " @47.54 label by=jo unit=1 ; @47.548 put unit=1 socket=A ; @51.137 station seconds=1.05 ;"
        " @60.0 label by=jo unit=1"
    ),
    "exchanged for a bootloader while the process is away": (
        "line sockets=1 ; unit label=1 application=none ; unit label=3 ; person name=al source=al ;"
        " @3.6 put unit=3 socket=A ; @5.0 card by=al unit=3 ; @6.0 label by=al unit=3 ;"
        " @31.5 worker socket=A ; @31.9 pull unit=3 ; @32.2 put unit=1 socket=A ; @38.0 look"
    ),
    "a unit that answers nothing is pulled": (
        "line sockets=1 ; unit label=1 answers=false ; person name=jo ; @3.0 put unit=1 socket=A ;"
        " @6.0 label by=jo unit=1 ; @8.8 card by=jo unit=1 ; @9.0 label by=jo unit=1 ;"
        " @10.0 pull unit=1"
    ),
    "a number that the unit does not tell": (
        "line sockets=1 recipe=plain ; unit label=1 ; unit label=2 number=other answers=false ;"
        " person name=jo source=mounted ; @11.8 put unit=2 socket=A ; @27.0 label by=jo unit=2 ;"
        " @27.5 pull unit=2 ; @31.5 put unit=2 socket=A"
    ),
    "pulled before the process of its socket stalls": (
        "line sockets=2 ; unit label=1 pace=slow ; person name=mo ; @3.0 put unit=1 socket=B ;"
        " @4.0 card by=mo unit=1 ; @5.0 label by=mo unit=1 ; @32.0 pull unit=1 ;"
        " @33.0 stall socket=B seconds=4.0 ; @36.5 look"
    ),
    "the label of an empty socket is scanned twice": (
        "line sockets=1 ; unit label=3 ; unit label=4 ; person name=al ;"
        " @13.0 label by=al unit=3 ; @21.0 card by=al unit=3 socket=A ;"
        " @21.5 label by=al unit=3 ; @22.0 put unit=4 socket=A"
    ),
    "silent since the process of its socket began": (
        "line sockets=2 ; unit label=1 pace=slow ; unit label=3 ; person name=jo ;"
        " @3.0 put unit=1 socket=B ; @3.5 card by=jo unit=1 socket=B ;"
        " @7.0 label by=jo unit=1 ; @8.0 worker socket=B ; @10.0 card by=jo unit=1 ;"
        " @10.5 pull unit=1 ; @10.78 put unit=3 socket=B ; @11.0 label by=jo unit=1"
    ),
    "pulled in its first announcement": (
        "line sockets=1 recipe=plain ; unit label=2 ; unit label=5 application=new ;"
        " person name=jo ; @2.0 card by=jo unit=2 socket=A ; @2.1 label by=jo unit=2 ;"
        " @2.74 put unit=2 socket=A ; @4.057 pull unit=2 ; @5.0 put unit=5 socket=A"
    ),
    "pulled in its first answer": (
        "line sockets=1 recipe=plain ; unit label=1 pace=slow ; unit label=5 application=new ;"
        " person name=al source=al ; @2.0 put unit=1 socket=A ; @5.9 label by=al unit=1 ;"
        " @8.324 pull unit=1 ; @9.0 put unit=5 socket=A"
    ),
    "pulled while the adapter is away, after its image was complete": (
        "line sockets=1 ; unit label=2 ; unit label=4 application=new ; person name=mo ;"
        " @3.5 put unit=2 socket=A ; @5.3 label by=mo unit=2 ; @5.9 unplug socket=A seconds=2.0 ;"
        " @6.1 pull unit=2 ; @8.4 put unit=4 socket=A"
    ),
    "pulled and exchanged while the adapter is away, after its image was complete": (
        "line sockets=1 ; unit label=2 ; unit label=4 application=new ; person name=mo ;"
        " @3.5 put unit=2 socket=A ; @5.3 label by=mo unit=2 ; @5.9 unplug socket=A seconds=2.0 ;"
        " @6.1 pull unit=2 ; @6.4 put unit=4 socket=A"
    ),
    "exchanged while the process stalls, after its image was complete": (
        "line sockets=1 ; unit label=2 ; unit label=4 application=new ; person name=mo ;"
        " @3.5 put unit=2 socket=A ; @5.3 label by=mo unit=2 ; @5.9 stall socket=A seconds=2.0 ;"
        " @6.1 pull unit=2 ; @6.4 put unit=4 socket=A"
    ),
    "pulled while the process stalls, before it is reset": (
        "line sockets=1 ; unit label=2 ; unit label=4 application=new ; person name=mo ;"
        " @3.5 put unit=2 socket=A ; @5.2 card by=mo unit=2 ; @5.3 label by=mo unit=2 ;"
        " @5.7017 stall socket=A seconds=1.0 ; @5.8017 pull unit=2 ; @6.8017 put unit=4 socket=A"
    ),
    "pulled while the process stalls, before the end of its transfer": (
        "line sockets=1 ; unit label=2 ; unit label=4 application=new ; person name=mo ;"
        " @3.5 put unit=2 socket=A ; @5.2 card by=mo unit=2 ; @5.3 label by=mo unit=2 ;"
        " @5.8747 stall socket=A seconds=1.0 ; @5.9747 pull unit=2 ; @6.9747 put unit=4 socket=A"
    ),
    "two exchanges at one pace, of which the second is of bootloaders": (
        "line sockets=2 ; unit label=1 ; unit label=3 pace=slow ; unit label=4 application=none ;"
        " person name=jo source=jo ; person name=al source=mounted ; @6.5 put unit=3 socket=B ;"
        " @8.72 label by=al unit=3 ; @10.958 pull unit=3 ; @48.577 put unit=1 socket=A ;"
        " @48.821 pull unit=1 ; @49.321 put unit=4 socket=A ; @50.097 card by=jo unit=4 ;"
        " @50.098 pull unit=4 ; @50.598 put unit=3 socket=A ; @51.153 label by=jo unit=4"
    ),
    "silent in the transfer of a run that was aborted": (
        "line sockets=1 ; unit label=1 pace=slow ; person name=jo ; @3.0 put unit=1 socket=A ;"
        " @5.0 label by=jo unit=1 ; @7.0 abort by=jo socket=A ; @11.5 card by=jo unit=1 ;"
        " @12.0 label by=jo unit=1"
    ),
    "pulled in its first answer after its run": (
        "line sockets=2 recipe=bicycle ; unit label=5 application=none pace=slow ;"
        " person name=jo ; person name=al source=mounted ; @53.0 put unit=5 socket=B ;"
        " @58.9 label by=al unit=5 ; @64.3 pull unit=5 ; @65.0 put unit=5 socket=B ;"
        " @66.0 worker socket=B ; @71.297 label by=jo unit=5 ; @76.297 pull unit=5 ; @81.0 look"
    ),
    "bootloaders that change places after equal pauses": (
        "line sockets=2 ; unit label=2 pace=slow ; unit label=3 number=other application=none ;"
        " person name=al source=al ; @2.0 put unit=2 socket=A ; @6.0 card by=al unit=2 ;"
        " @9.5 label by=al unit=2 ; @11.5 pull unit=2 ; @16.0 put unit=3 socket=B ;"
        " @19.2 pull unit=3 ; @19.5 put unit=2 socket=B ; @20.0 card by=al unit=2 ;"
        " @20.1 pull unit=2 ; @20.4 put unit=3 socket=B ; @20.5 label by=al unit=2"
    ),
    "a bootloader that was away for some seconds": (
        "line sockets=1 ; unit label=1 ; unit label=2 application=none pace=slow ; person name=jo ;"
        " @3.0 put unit=1 socket=A ; @5.0 label by=jo unit=1 ; @11.0 pull unit=1 ;"
        " @12.0 put unit=1 socket=A ; @16.5 pull unit=1 ; @17.0 put unit=2 socket=A ;"
        " @17.17 card by=jo unit=2 ; @17.2 label by=jo unit=2 ; @18.0 pull unit=2 ;"
        " @22.0 put unit=2 socket=A ; @23.5 pull unit=2 ; @24.0 put unit=1 socket=A"
    ),
    "put in while the process of the socket stalls": (
        "line sockets=1 recipe=wmc ; unit label=1 ; unit label=2 ; person name=jo ;"
        " @3.0 stall socket=A seconds=4.0 ; @4.0 label by=jo unit=1 ; @5.0 put unit=2 socket=A"
    ),
    "erases still when its next run begins": (
        "line sockets=1 recipe=bicycle ; unit label=1 application=new ;"
        " unit label=2 number=other application=none pace=slow ; person name=jo source=mounted ;"
        " @1.0 put unit=2 socket=A ; @1.6 label by=jo unit=2 ; @4.8 pull unit=2 ;"
        " @5.1 put unit=1 socket=A ; @6.0 pull unit=1 ; @6.5 put unit=2 socket=A ;"
        " @7.0 label by=jo unit=2"
    ),
    "silent in a transfer that was aborted, and its label alone": (
        "line sockets=1 recipe=held ; unit label=3 pace=slow ; person name=jo ; person name=al ;"
        " @1.0 put unit=3 socket=A ; @2.0 label by=jo unit=3 ; @3.5 abort by=al socket=A ;"
        " @4.0 label by=al unit=3"
    ),
    "everything dies": (
        "line sockets=2 ; unit label=1 pace=slow ; unit label=2 application=none ;"
        " person name=jo source=mounted ; @3.0 put unit=1 socket=A ; @4.0 label by=jo unit=1 ;"
        " @4.5 worker socket=A ; @7.0 label by=jo unit=1 ; @7.1 stall socket=A seconds=0.4 ;"
        " @7.6 dip socket=A seconds=0.5 ;"
        " @12.0 put unit=2 socket=B ; @13.0 label by=jo unit=2 ; @13.4 station seconds=2.0 ;"
        " @17.0 sleep unit=1 seconds=4.0 ; @18.0 label by=jo unit=1"
    ),
}


def noted(text: str) -> Played:
    return play(Story.parse(text))


@pytest.mark.parametrize("name", STORIES)
def test_no_label_ends_on_another_unit_and_nothing_blocks(name: str) -> None:
    assert noted(STORIES[name]).text == ""


def test_units_that_are_not_exchanged_pass() -> None:
    played = noted(
        "line sockets=2 ; unit label=1 ; unit label=2 number=maker ; unit label=3 number=own ;"
        " person name=jo ; @3.0 put unit=1 socket=A ; @4.0 card by=jo unit=1 ;"
        " @4.5 label by=jo unit=1 ; @5.0 put unit=2 socket=B ; @6.0 card by=jo unit=2 ;"
        " @6.5 label by=jo unit=2 ; @12.0 pull unit=1 ; @13.0 put unit=3 socket=A ;"
        " @17.0 label by=jo unit=3"
    )
    assert played.seen is not None
    assert (played.text, played.seen["PASS OK"], played.seen["runs"]) == ("", 3, 3)


@pytest.mark.parametrize(
    ("recipe", "acts", "outcome"),
    [
        ("wmc", "@9.0 look", "PASS OK"),
        ("obc", "@9.0 look", "PASS OK"),
        ("bicycle", "@9.0 look", "PASS OK"),
        ("held", "@5.6 dip socket=A seconds=0.3 ; @9.0 look", "PASS OK"),
        ("writes", "@5.6 dip socket=A seconds=0.3 ; @9.0 look", "ERROR UNIT_CHANGED"),
        ("wmc", "@5.5 pull unit=1 ; @5.8 put unit=2 socket=A", "ERROR UNIT_CHANGED"),
        ("bicycle", "@6.3 pull unit=1 ; @6.6 put unit=2 socket=A", "ERROR UNIT_CHANGED"),
    ],
)
def test_a_run_of_a_recipe_ends(recipe: str, acts: str, outcome: str) -> None:
    played = noted(
        f"line sockets=1 recipe={recipe} ; unit label=1 pace=slow ; unit label=2 ; person name=jo ;"
        f" @3.0 put unit=1 socket=A ; @4.0 card by=jo unit=1 ; @4.5 label by=jo unit=1 ; {acts}"
    )
    assert played.text == ""
    assert played.seen is not None
    assert played.seen[outcome] > 0


def test_who_cannot_be_asked_has_to_stay_from_its_first_update_command_on() -> None:
    played = noted(
        "line sockets=1 recipe=wmc ; unit label=1 pace=slow ; unit label=3 pace=slow ;"
        " person name=jo source=jo ; @2.0 label by=jo unit=3 ; @2.8 put unit=3 socket=A ;"
        " @3.0 pull unit=3 ; @3.5 put unit=1 socket=A"
    )
    assert played.text == ""
    assert played.seen is not None
    assert played.seen["ERROR UNIT_CHANGED"] == 1


@pytest.mark.parametrize("again", ["", " @11.5 card by=al unit=2 ;"])
def test_a_unit_that_no_one_could_ask_is_counted_by_how_it_was_exchanged(again: str) -> None:
    """Also when somebody else scans the card that waits once more, at the same page."""
    played = noted(
        "line sockets=1 recipe=wmc ; unit label=1 ; unit label=2 ; person name=jo ;"
        " person name=al ; @3.0 put unit=1 socket=A ; @9.0 card by=jo unit=1 ;"
        f" @10.0 pull unit=1 ; @11.0 put unit=2 socket=A ;{again}"
        " @12.0 label by=jo unit=1 ; @20.0 look"
    )
    assert played.text == ""
    assert played.seen is not None
    assert played.seen["undetectable: exchanged between its card and its label"] == 1


def test_a_unit_that_an_aborted_run_left_silent_in_its_transfer_is_scanned_twice() -> None:
    """It looks like one that was pulled: the first scan ends as UNIT_CHANGED."""
    played = noted(
        "line sockets=1 recipe=held ; unit label=2 pace=slow ; person name=jo ; person name=al ;"
        " @3.0 put unit=2 socket=A ; @19.0 label by=jo unit=2 ; @20.0 station seconds=1.0 ;"
        " @29.0 pull unit=2 ; @99.04 put unit=2 socket=A ; @103.0 card by=al unit=2 socket=A ;"
        " @103.2 label by=al unit=2 ; @105.6 abort by=al socket=A ; @107.8 label by=al unit=2"
    )
    assert played.text == ""
    assert played.seen is not None
    assert played.seen["ERROR UNIT_CHANGED"] == 1


def test_a_label_whose_card_was_used_up_is_not_taken_for_one_that_was_scanned_alone() -> None:
    """Two people at one page scan the same card; the label of the first is refused. The label of
    the second follows before the refusal is read, when another unit is in the socket."""
    played = noted(
        "line sockets=1 recipe=plain ; unit label=1 ; unit label=2 ; unit label=3 ;"
        " person name=jo ; person name=al ; @10.0 put unit=1 socket=A ; @12.2 label by=jo unit=1 ;"
        " @12.4 pull unit=1 ; @13.0 put unit=2 socket=A ; @29.0 card by=al unit=2 ;"
        " @30.0 card by=jo unit=2 ; @30.3 pull unit=2 ; @30.57 put unit=3 socket=A ;"
        " @30.6 label by=al unit=2 ; @31.0 label by=jo unit=2"
    )
    assert played.text == ""


def test_a_label_whose_card_was_forgotten_is_not_taken_for_one_that_was_scanned_alone() -> None:
    """A person reads the label 15 s after its card, when the units have changed places."""
    played = noted(
        "line sockets=1 recipe=plain ; unit label=1 ; unit label=2 ; person name=al ;"
        " @3.0 put unit=1 socket=A ; @10.0 card by=al unit=1 ; @24.7 pull unit=1 ;"
        " @25.05 put unit=2 socket=A ; @25.2 label by=al unit=1 ; @35.0 look"
    )
    assert played.text == ""


def test_a_unit_that_came_in_a_stall_is_not_the_one_of_the_card_before() -> None:
    """The run begins in the moment in which the arrival of the other unit is read, 2.1 s late."""
    played = noted(
        "line sockets=1 recipe=plain ; unit label=1 number=maker ; unit label=2 number=own"
        " pace=slow ; person name=jo source=jo ; person name=al ;"
        " @22.676289 put unit=2 socket=A ; @27.084739 label by=al unit=2 ;"
        " @29.332889 pull unit=2 ; @29.582889 put unit=1 socket=A ;"
        " @32.743273 dip socket=A seconds=0.05 ; @34.748137 label by=al unit=1 ;"
        " @34.815496 pull unit=1 ; @38.315496 put unit=1 socket=A ;"
        " @43.060074 label by=jo unit=1 ; @43.530433 stall socket=A seconds=4.0 ;"
        " @45.0 card by=al unit=1 ; @45.1 pull unit=1 ; @45.4 put unit=2 socket=A ;"
        " @45.5 label by=al unit=1 ; @50.0 look"
    )
    assert played.text == ""


def test_what_cannot_be_saved_is_never_green_and_the_line_goes_on() -> None:
    played = noted(
        "line sockets=1 ; unit label=1 ; person name=jo ; @3.0 put unit=1 socket=A ;"
        " @4.0 card by=jo unit=1 ; @4.5 label by=jo unit=1 ; @5.0 disk seconds=6.0 ; @9.0 look ;"
        " @10.0 resume by=jo ; @12.0 resume by=jo"
    )
    assert played.text == ""
    assert [each.NAME for each in played.done][-2:] == ["resume", "resume"]


def test_the_campaign_names_each_word_of_a_story_and_each_kind_of_violation() -> None:
    assert line_world.__doc__ is not None
    folder = Path(line_world.__file__).parent
    raised = "\n".join(path.read_text("utf-8") for path in folder.glob("*.py"))
    kinds = set(re.findall(r'Violation\(\s*"([A-Z ]+)"', raised)) | {STUCK}
    named = set(re.findall(r"^    ([A-Z]+(?: [A-Z]+)*)  ", line_world.__doc__, re.MULTILINE))
    assert named == kinds
    assert [word for word in CLAUSES if f"{word} " not in line_world.__doc__] == []


@pytest.mark.parametrize("seed", range(SAMPLE))
def test_a_drawn_story_has_no_violation_and_is_read_as_it_is_printed(seed: int) -> None:
    """The first seeds that there are, not chosen ones."""
    played = draw(seed, SAMPLE_ACTS)
    assert not played.kind, f"{played.text}\n  {played.story}"
    assert Story.parse(str(played.story)) == played.story


def test_lines_without_numbers_are_drawn_an_exchange_in_an_outage() -> None:
    """Ten stories find the mistake that shows in such an exchange alone."""
    bug = next(each for each in read_bugs() if each.name == "green-over-the-next")
    seeds = (seed for seed in count() if setup_of(Random(seed)).line.recipe == "plain")
    with swapped(bug.codes()):
        assert any(draw(seed, ACTS).kind == bug.kind for seed in islice(seeds, 10))


_LOG_HASH: Final = re.compile(r"log_sha256='\w+'")


def course(seed: int) -> tuple[Story, list[str]]:
    """The story of a seed and everything that is shown in it."""
    shown: list[str] = []
    story = draw(seed, 8, shown.append).story
    return story, without_folders(shown)


def without_folders(shown: list[str]) -> list[str]:
    """Logs name the folder of a play."""
    return [_LOG_HASH.sub("", each) for each in shown]


def digest(course: tuple[Story, list[str]]) -> str:
    story, shown = course
    return sha256("\n".join([str(story), *shown]).encode()).hexdigest()


def test_a_seed_takes_the_same_course_in_each_process_and_when_it_is_played() -> None:
    module = "tests.station.test_line_stories"
    command = f"from {module} import course, digest; print(digest(course(5)))"
    seed = "1" if os.environ.get("PYTHONHASHSEED") != "1" else "2"
    other = run(
        [sys.executable, "-c", command],
        cwd=Path(__file__).parents[2],
        env={**os.environ, "PYTHONHASHSEED": seed},
        capture_output=True,
        text=True,
        check=True,
    )
    drawn = course(5)
    assert other.stdout.strip() == digest(drawn)
    again: list[str] = []
    play(drawn[0], again.append)
    assert without_folders(again) == drawn[1]


def test_no_step_puts_a_unit_where_another_one_is_awaited() -> None:
    put = "@6.0 put unit=2 socket=A"
    text = (
        "line sockets=2 ; unit label=1 ; unit label=2 ; person name=jo ;"
        f" @3.0 card by=jo unit=1 socket=A ; @4.0 label by=jo unit=1 ; {put}"
    )
    assert [each.NAME for each in noted(text).done] == ["card", "label"]
    without = text.replace("@4.0 label by=jo unit=1 ;", "")
    assert [each.NAME for each in noted(without).done] == ["card", "put"]


# -- what cannot be detected -----------------------------------------------------------------------

RESET = "between the confirmed reset and the announcement"
COMPLETE = "between the complete image and the first answer"
SILENT = "silent when its label was scanned"
UNDETECTABLE = {
    "restarts for the run": (
        RESET,
        (
            "line sockets=2 ; unit label=2 ; unit label=3 ; person name=al ;"
            " @31.1 label by=al unit=3 ; @31.5 put unit=3 socket=A ; @33.55 card by=al unit=3 ;"
            " @34.0 pull unit=3 ; @34.5 put unit=2 socket=A"
        ),
    ),
    "two change places, of which one restarts for its run": (
        RESET,
        (
            "line sockets=2 recipe=plain ; unit label=1 ; unit label=2 ; person name=jo ;"
            " @21.9 put unit=2 socket=B ; @23.9 put unit=1 socket=A ;"
            " @24.2 card by=jo unit=1 ; @24.8 label by=jo unit=1 ; @38.8 card by=jo unit=2 ;"
            " @42.1 label by=jo unit=2 ; @42.8 pull unit=1 ; @42.9 pull unit=2 ;"
            " @43.15 put unit=1 socket=B ; @43.25 put unit=2 socket=A"
        ),
    ),
    "pulled in the first frame of its announcement": (
        RESET,
        (
            "line sockets=1 recipe=plain ; unit label=2 ; unit label=5 application=new ;"
            " person name=jo ; @2.0 card by=jo unit=2 socket=A ; @2.1 label by=jo unit=2 ;"
            " @2.74 put unit=2 socket=A ; @4.0564 pull unit=2 ; @5.0 put unit=5 socket=A"
        ),
    ),
    "starts, and answers nothing": (
        COMPLETE,
        (
            "line sockets=2 ; unit label=2 application=new ; unit label=5 answers=false ;"
            " person name=jo ; @3.0 card by=jo unit=5 socket=B ; @3.5 label by=jo unit=5 ;"
            " @4.0 put unit=5 socket=B ; @12.0 pull unit=5 ; @13.0 put unit=2 socket=B"
        ),
    ),
    "starts with a maker's number, and answers nothing": (
        COMPLETE,
        (
            "line sockets=2 ; unit label=2 number=maker answers=false ;"
            " unit label=4 application=new ; person name=jo source=jo ;"
            " @51.2 put unit=2 socket=B ; @51.23 card by=jo unit=2 ; @51.24 label by=jo unit=2 ;"
            " @58.8 pull unit=2 ; @59.1 put unit=4 socket=B"
        ),
    ),
    "starts in place of the unit with the label, which comes then": (
        COMPLETE,
        (
            "line sockets=1 recipe=plain ; unit label=1 number=own application=new ;"
            " unit label=3 application=none ; person name=jo source=jo ;"
            " @3.0 dip socket=A seconds=4.0 ; @6.28 put unit=1 socket=A ;"
            " @6.8 card by=jo unit=1 ; @6.81 pull unit=1 ; @7.1 put unit=3 socket=A ;"
            " @7.2 label by=jo unit=1 ; @8.6 pull unit=3 ; @10.0 put unit=1 socket=A"
        ),
    ),
    "starts, and a third unit is in its socket for a moment": (
        COMPLETE,
        (
            "line sockets=1 recipe=plain ; unit label=1 application=new pace=slow ;"
            " unit label=2 application=none pace=slow ; unit label=3 ; person name=al ;"
            " @0.53 put unit=2 socket=A ; @0.887 card by=al unit=2 ; @1.145 label by=al unit=2 ;"
            " @4.3 pull unit=2 ; @6.287 put unit=3 socket=A ; @6.289 pull unit=3 ;"
            " @7.289 put unit=1 socket=A ; @12.0 look"
        ),
    ),
    "starts, after it had come for a silent one whose label was scanned": (
        COMPLETE,
        (
            "line sockets=2 recipe=bicycle ; unit label=1 answers=false ; unit label=2"
            " application=new ; unit label=3 application=none answers=false ; person name=al ;"
            " @3.0 put unit=1 socket=B ; @13.0 card by=al unit=1 ; @13.1 pull unit=1 ;"
            " @14.0 put unit=3 socket=B ; @14.1 label by=al unit=1 ; @17.0 pull unit=3 ;"
            " @18.0 put unit=2 socket=B"
        ),
    ),
    "without power": (
        SILENT,
        (
            "line sockets=2 ; unit label=1 ; unit label=2 ; person name=mo ;"
            " @2.0 dip socket=B seconds=4.0 ; @3.0 put unit=1 socket=B ;"
            " @3.1 card by=mo unit=1 socket=B ; @3.5 pull unit=1 ; @4.0 put unit=2 socket=B ;"
            " @7.0 label by=mo unit=1"
        ),
    ),
    "a target that tells nothing, when its image is complete": (
        "exchanged when its image was complete",
        (
            "line sockets=2 recipe=wmc ; unit label=1 pace=slow ; unit label=2 ; person name=jo ;"
            " person name=al source=mounted ; @2.0 put unit=1 socket=B ; @2.03 label by=al unit=1 ;"
            " @2.5 pull unit=1 ; @3.0 put unit=2 socket=B ; @6.0 pull unit=2 ;"
            " @23.24 put unit=1 socket=A ; @31.0 card by=jo unit=1 ; @31.13 label by=jo unit=1 ;"
            " @31.17 pull unit=1 ; @35.0 put unit=2 socket=A"
        ),
    ),
}


@pytest.mark.parametrize("name", UNDETECTABLE)
def test_what_no_one_can_detect_is_counted_by_its_reason(name: str) -> None:
    reason, story = UNDETECTABLE[name]
    played = noted(story)
    assert played.seen is not None
    assert (played.text, played.seen[f"undetectable: {reason}"]) == ("", 1)


def test_each_reason_is_of_a_story() -> None:
    assert set(undetectable.UNDETECTABLE) <= {reason for reason, _ in UNDETECTABLE.values()}


@pytest.mark.parametrize("state", list(BootloaderState))
def test_a_unit_that_answers_something_else_can_be_detected(state: BootloaderState) -> None:
    exchanges = undetectable.Exchanges()
    pulled = undetectable.Pulled("W2605001", 3.0, state, StepName.FLASH, was_silent=False)
    for socket, is_alike in (("A", True), ("B", False)):
        exchanges.pull(socket, pulled)
        exchanges.put(socket, "W2605002", 3.5, is_new=True, is_alike=is_alike)
    text = "the unit with the label W2605002 now says that it is W2605001"
    alike = exchanges.reason_of(Violation("NUMBER", text, "A"))
    assert bool(alike) == (state in (BootloaderState.RESTARTING, BootloaderState.STARTING))
    assert exchanges.reason_of(Violation("NUMBER", text, "B")) == ""


@pytest.mark.parametrize("is_silent", [True, False])
def test_of_two_exchanges_both_have_to_be_undetectable(*, is_silent: bool) -> None:
    exchanges, step = undetectable.Exchanges(), StepName.FLASH
    first = undetectable.Pulled("W2605001", 3.0, None, None, was_silent=is_silent)
    starts = BootloaderState.STARTING
    second = undetectable.Pulled("W2605003", 9.0, starts, step, was_silent=False)
    exchanges.pull("A", first)
    exchanges.put("A", "W2605003", 3.5, is_new=False, is_alike=True)
    exchanges.pull("A", second)
    exchanges.put("A", "W2605002", 9.5, is_new=True, is_alike=True)
    text = "the unit with the label W2605002 now says that it is W2605001"
    assert bool(exchanges.reason_of(Violation("NUMBER", text, "A"))) == is_silent


def test_what_somebody_could_detect_is_a_violation(monkeypatch: pytest.MonkeyPatch) -> None:
    story = (
        "line sockets=1 ; unit label=1 ; unit label=3 application=none ; person name=mo ;"
        " @2.0 put unit=3 socket=A ; @4.0 card by=mo unit=3 ; @4.5 label by=mo unit=3 ;"
        " @5.0 pull unit=3 ; @5.5 put unit=1 socket=A"
    )
    assert noted(story).text == ""
    monkeypatch.setattr(Continuity, "_lose", lambda *_: None)
    assert noted(story).kind == "NUMBER"


# -- faults that the oracle has to find, beside those of `tests.campaigns.line_bugs` ---------------


def report_no_unit_after_a_run(patch: pytest.MonkeyPatch) -> None:
    begin, change = Presence.begin, Presence.change

    def begin_again(self: Presence) -> None:
        begin(self)
        vars(self)["begun"] = vars(self).get("begun", 0) + 1

    patch.setattr(Presence, "begin", begin_again)
    patch.setattr(
        Presence, "change", lambda self, now: change(self, now) if self.begun == 1 else None
    )


def accuse_everybody(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(UnitRun, "_changed", lambda *_: StepFailedError(Code.UNIT_CHANGED, "It differs."))


def write_and_fail(patch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> None:
        raise StepFailedError(Code.NOT_RUNNING, "It does not answer.")

    patch.setattr(UnitSteps, "_verify", fail)


def never_begin(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(Socket, "is_due", lambda *_: False)


def trust_every_run(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(runs, "OF_ANOTHER", frozenset())


def count_whole_announcements(patch: pytest.MonkeyPatch) -> None:
    counted = property(lambda self: self.announcements, lambda *_: None)
    patch.setattr(TargetWatcher, "begun_announcements", counted, raising=False)


def expect_a_start_until_the_first_answer(patch: pytest.MonkeyPatch) -> None:
    counted = property(lambda _: 0, lambda *_: None)
    patch.setattr(TargetWatcher, "application_frames", counted, raising=False)


@pytest.mark.parametrize(
    ("plant", "story", "kind"),
    [
        (count_whole_announcements, STORIES["pulled in its first announcement"], "FALSE PASS"),
        (
            expect_a_start_until_the_first_answer,
            STORIES["pulled in its first answer"],
            "FALSE PASS",
        ),
        (report_no_unit_after_a_run, PASSED_AND_EXCHANGED, "GREEN"),
        (accuse_everybody, PASSED_AND_EXCHANGED, "ACCUSED"),
        (write_and_fail, PASSED_AND_EXCHANGED, "STUCK"),
        (never_begin, PASSED_AND_EXCHANGED, "STUCK"),
        (trust_every_run, NOT_OBSERVED_AFTER_ITS_FLASH, "TRUSTED"),
    ],
)
def test_a_fault_of_the_station_is_found(
    plant: Callable[[pytest.MonkeyPatch], None],
    story: str,
    kind: str,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    plant(monkeypatch)
    assert noted(story).kind == kind


def test_a_story_is_shrunk_to_what_it_needs() -> None:
    (bug,) = (each for each in read_bugs() if each.name == "one-card-for-all")
    with swapped(bug.codes()):
        found = noted(CARD_HERE_LABEL_THERE.replace("@4.0", "@2.5 free by=al socket=A ; @4.137"))
        assert found.kind == bug.kind
        story = shrink(found).story
    assert [each.NAME for each in story.acts] == ["put", "card", "label"]
    assert all(each.when is not None and each.when.plus_s % 0.5 == 0 for each in story.acts)
