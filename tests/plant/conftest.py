from __future__ import annotations

import asyncio
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.plant.broker import find_mosquitto
from tests.plant.factory import Plant, Sender
from tests.station.postgres import Server


@pytest.fixture
def plant(postgres: Server, tmp_path: Path) -> Iterator[Plant]:
    """A plant's database for the stations line-2 and line-3, with nothing in it."""
    made = Plant(postgres, tmp_path)
    yield made
    made.drop()


@pytest.fixture
def sender(plant: Plant) -> Iterator[Sender]:
    """Line-2 with its forwarder."""
    made = plant.sender("line-2")
    yield made
    made.close()


@pytest.fixture(autouse=True)
def no_running_loop() -> Iterator[None]:
    """In a process that has driven a browser, Playwright's loop runs until its end."""
    loop = asyncio._get_running_loop()
    asyncio._set_running_loop(None)
    yield
    asyncio._set_running_loop(loop)


@pytest.fixture(scope="session")
def mosquitto() -> str:
    """The program of a real broker."""
    found = find_mosquitto()
    if found is None:
        pytest.skip("Mosquitto is not installed (Debian: apt-get install mosquitto)")
    return found
