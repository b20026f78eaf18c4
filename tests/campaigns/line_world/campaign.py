"""Stories as the runs of a campaign of `flasher.simulate`."""

from __future__ import annotations

import hashlib
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Final

from flasher.simulate.campaign import Batch, Found, Result, campaign_key
from flasher.simulate.plan import Plan
from tests.campaigns.line_world.play import draw

STEPS: Final = "steps"
"""Key of the number of acts that were done, among the endings of a result."""
_TESTS: Final = Path(__file__).parents[2]


class Stories(Batch):
    """Stories, each drawn from its seed."""

    def plan_of(self, number: int) -> Plan:
        """A story is drawn while it is played, so one that ends its process is its seed alone."""
        return Plan(())


def stories_key(acts: int) -> str:
    """Return a hash of all that decides the story of a seed."""
    digest = hashlib.sha256(f"{campaign_key()} {acts}".encode())
    for folder in ("campaigns/line_world", "station"):
        for file in sorted((_TESTS / folder).glob("*.py")):
            digest.update(file.read_bytes())
    return campaign_key() + "-line-" + digest.hexdigest()[:16]


def play_batch(
    batch: Batch, is_stopped: Callable[[], bool] = lambda: False, *, acts: int
) -> Result:
    """Play the stories of a batch; once stopped, the sum of those that were played."""
    began_s = time.process_time()
    seen: Counter[str] = Counter()
    found: list[Found] = []
    stories = digest = 0
    for seed in range(batch.first, batch.first + batch.count):
        if is_stopped():
            break
        story = draw(seed, acts)
        stories += 1
        seen += Counter({STEPS: len(story.done)}) + (story.seen or Counter())
        if story.kind:
            found.append(Found(seed, story.kind, story.text, str(story.story)))
        text = f"{seed} {story.kind} {story.story}"
        digest ^= int.from_bytes(hashlib.sha256(text.encode()).digest()[:8], "big")
    return Result(
        batch.campaign,
        runs=stories,
        endings=dict(seen),
        violations=tuple(found),
        violation_count=len(found),
        digest=f"{digest:016x}",
        cpu_s=time.process_time() - began_s,
    )
