"""Back end of the bench: what it needs of real or virtual bikes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Protocol, Unpack

from flasher.api import CallOptions, Connection
from flasher.history import Flash
from flasher.jobs import Job
from flasher.protocol.spec import Dialect, Target
from flasher.settings.area import Area
from flasher.settings.profile import Profile
from flasher.web.bench_state import Adapter, Saved, UpgradeEnding


class BenchBackend(Protocol):
    """Access to the devices. Methods raise FlasherError."""

    dialect: Dialect

    def adapters(self, cancelled: Callable[[], bool]) -> Sequence[Adapter]: ...
    def use(self, adapter: Adapter) -> None: ...
    def profile(self, target: Target) -> Profile: ...
    def bitrate_bps(self, adapter: Adapter) -> int: ...
    def is_physical(self, adapter: Adapter) -> bool: ...
    def images(self) -> Sequence[Path]: ...
    def sets(self) -> Sequence[Path]: ...
    def dropped(self) -> Sequence[str]: ...
    def unfinished(self) -> Flash | None: ...
    def use_folder(self, path: str) -> None: ...
    def connect(self, adapter: Adapter, *, asks: bool = True) -> AbstractContextManager[Connection]:
        """Open an adapter. With `asks` False, nothing may be sent."""

    def model_area(self) -> Area | None:
        """Memory area of a device model; None for real devices."""

    def back_up(self, adapter: Adapter, area: Area | None, **watch: Unpack[CallOptions]) -> Saved:
        """Save the battery's answers and the memory of an area to a new file."""

    def upgrade(
        self,
        adapter: Adapter,
        job: Job,
        connect: Callable[[], AbstractContextManager[Connection]],
        *,
        keeps_settings: bool,
        **watch: Unpack[CallOptions],
    ) -> UpgradeEnding:
        """Run an upgrade to its end and store its records; `connect` opens the adapter."""
