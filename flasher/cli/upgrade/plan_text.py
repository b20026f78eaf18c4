"""An image and its plan in words and as JSON, for `image-info`, `flash` and `--dry-run`."""

from __future__ import annotations

from flasher.cli.documents import ImageDocument, PlanDocument
from flasher.cli.output import byte_count, counted, duration
from flasher.host.options import UpgradeOptions, gaps_s
from flasher.image.cortexm import VectorTable
from flasher.image.image import Image
from flasher.image.plan import Plan
from flasher.image.release import names_of
from flasher.protocol.spec import DIALECTS
from flasher.protocol.text import printable


def image_lines(image: Image) -> list[str]:
    """What is in the file."""
    lines = [f"{printable(image.source)}: {image.format}, {byte_count(image.size_bytes)} to send"]
    if image.base is None:
        lines.append("  address: unknown (a raw binary has none; --base tells it)")
    else:
        last = image.base + image.size_bytes - 1
        lines.append(f"  address: 0x{image.base:08X}..0x{last:08X}")
    if len(image.segments) > 1:
        lines += [f"  segment: {segment}" for segment in image.segments]
        lines.append(f"  gaps:    {byte_count(image.filled_bytes)} filled with FF")
    lines.append(f"  version: {image.version or 'none found inside'}")
    lines.append(f"  names:   {names_of(image.named_targets) or 'no target found inside'}")
    lines.append(f"  sha256:  {image.sha256}")
    return lines


def vector_lines(table: VectorTable | None) -> list[str]:
    """Whether it looks like a Cortex-M application."""
    if table is None:
        return ["  start:   too short for a vector table"]
    words = f"stack pointer 0x{table.stack_pointer:08X}, reset vector 0x{table.reset_vector:08X}"
    verdict = "plausible for a Cortex-M" if table.plausible else "not plausible for a Cortex-M"
    lines = [f"  start:   {words}: {verdict}"]
    lines += [f"           {problem}" for problem in table.problems]
    lines += [f"           {note}" for note in table.notes]
    return lines


def plan_lines(plan: Plan, options: UpgradeOptions) -> list[str]:
    """What would be sent to whom, and how long it takes on the bus, gaps included."""
    target = plan.target
    ids = f"CAN ids 0x{target.request_id:03X}, 0x{target.answer_id:03X}"
    document_bps = {dialect.bitrate_bps for dialect in DIALECTS.values() if dialect.has_upgrade}
    foreign = "" if plan.bitrate_bps in document_bps else " (not the document's bit rate)"
    sent = f"{counted(plan.total_packets, 'packet')}, {counted(plan.frames, 'frame')}"
    silence_s = gaps_s(plan, options)
    time = f"{duration(plan.wire_s)} on the wire"
    if silence_s:
        time = f"{duration(plan.wire_s + silence_s)}: {time}, {duration(silence_s)} of gaps"
    return [
        f"  to:      {target.node.name} ({ids}) at {plan.bitrate_bps / 1000:g} kbit/s{foreign}",
        f"  plan:    {sent}, {byte_count(plan.bytes_on_wire)} of frame data",
        f"  time:    {time}, erasing and the device's own time extra",
    ]


def image_document(image: Image, table: VectorTable | None) -> ImageDocument:
    """The image as JSON."""
    return {
        "source": image.source,
        "format": image.format,
        "size_bytes": image.size_bytes,
        "base": image.base,
        "segments": [{"start": s.start, "size_bytes": s.size_bytes} for s in image.segments],
        "filled_bytes": image.filled_bytes,
        "version": image.version,
        "named_targets": sorted(target.name for target in image.named_targets),
        "sha256": image.sha256,
        "vector_table": None
        if table is None
        else {
            "stack_pointer": table.stack_pointer,
            "reset_vector": table.reset_vector,
            "plausible": table.plausible,
            "problems": list(table.problems),
            "notes": list(table.notes),
        },
    }


def plan_document(plan: Plan, options: UpgradeOptions) -> PlanDocument:
    """The plan as JSON."""
    return {
        "target": plan.target.name,
        "request_id": plan.target.request_id,
        "answer_id": plan.target.answer_id,
        "bitrate_bps": plan.bitrate_bps,
        "packets": plan.total_packets,
        "frames": plan.frames,
        "bytes_on_wire": plan.bytes_on_wire,
        "wire_s": round(plan.wire_s, 6),
        "gaps_s": round(gaps_s(plan, options), 6),
    }
