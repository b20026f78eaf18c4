"""The command line, as its own tests run it."""

from tests.cli.conftest import flasher as flasher  # noqa: PLC0414  a fixture
