# ruff: noqa: S608  all of this SQL is written here
"""Recipes given out from the centre: published once, fetched whole or not at all, withdrawn."""

from __future__ import annotations

import errno
import hashlib
import os
import random
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import psycopg
import pytest

from flasher.errors import UsageError
from flasher.plant import recipes
from flasher.plant.central import Central
from flasher.plant.fetcher import Fetcher
from flasher.plant.recipes import events_of, publish, withdraw
from flasher.plant.release_functions import PIECE_BYTES
from flasher.plant.setup import PUBLISHERS, setup
from flasher.station import given_recipes
from flasher.station.given_recipes import Bundle, RecipeFolder, bundle_of
from flasher.station.recipe_file import load_checked
from flasher.station.records.errors import RecordError
from flasher.station.records.model import AuditEvent
from tests.plant.factory import PASSWORD, STATIONS, Plant, Sender
from tests.plant.old_databases import make_old
from tests.station.factory import DAY, USUAL, make_recipe, write_recipe

PUBLISHER = "flasher_anna"
REVISION_5 = USUAL.replace('revision = "4"', 'revision = "5"')


class Centre:
    """Who publishes, and line-2 that fetches."""

    def __init__(self, plant: Plant, sender: Sender) -> None:
        self.plant = plant
        with plant.connect() as admin:
            admin.autocommit = True
            if not admin.execute(
                "SELECT 1 FROM pg_roles WHERE rolname = %s", [PUBLISHER]
            ).fetchone():
                admin.execute(f"CREATE ROLE {PUBLISHER} LOGIN PASSWORD '{PASSWORD}'".encode())
                admin.execute(f"GRANT {PUBLISHERS} TO {PUBLISHER}".encode())
        self.central = Central(plant.url(PUBLISHER))
        self.folder = RecipeFolder.of(sender.folder, "line-2")
        self.sender = sender
        self.fetcher = Fetcher(
            Central(plant.url("flasher_line_2")),
            sender.bench.opened().database,
            self.folder,
            "line-2",
            ["A", "B"],
        )

    def publish(
        self, text: str, stations: tuple[str, ...] = (), sockets: tuple[str, ...] = ()
    ) -> str:
        loaded = make_recipe(self.source, text)
        return publish(self.central, loaded, stations, sockets, DAY).digest

    @property
    def source(self) -> Path:
        folder = self.plant.folder / "source"
        folder.mkdir(exist_ok=True)
        return folder

    def given(self) -> dict[str, tuple[str, ...]]:
        """Fetch; the sockets of each recipe."""
        return {each.digest: each.sockets for each in self.fetcher.fetch().recipes}


@pytest.fixture
def centre(plant: Plant, sender: Sender) -> Iterator[Centre]:
    made = Centre(plant, sender)
    yield made
    made.central.close()
    made.fetcher.close()


def test_a_recipe_is_stored_once_and_fetched_by_its_stations(centre: Centre) -> None:
    assert centre.given() == {}
    digest = centre.publish(REVISION_5, ("line-2",))
    assert centre.publish(REVISION_5, ("line-3",)) == digest
    assert centre.plant.rows("SELECT count(*) FROM released_file") == [(3,)]
    found = centre.fetcher.fetch()
    assert (found.new, found.recipes[0].sockets) == ((digest,), ("A", "B"))
    assert centre.folder.load(digest, DAY).recipe.revision == "5"
    assert centre.fetcher.fetch().new == ()
    assert [(each.what, each.station, each.by) for each in events_of(centre.central)] == [
        ("published", "line-2", PUBLISHER),
        ("published", "line-3", PUBLISHER),
    ]


def test_the_newest_publication_for_a_socket_counts(centre: Centre) -> None:
    first = centre.publish(REVISION_5)
    second = centre.publish(REVISION_5.replace('"5"', '"6"'), ("line-2",), ("B",))
    centre.publish(REVISION_5.replace('"5"', '"7"'), ("line-3",))
    assert centre.given() == {first: ("A",), second: ("B",)}
    third = centre.publish(REVISION_5.replace('"5"', '"8"'))
    assert centre.given() == {third: ("A", "B")}


def test_a_withdrawn_recipe_is_given_to_no_station_and_stays_where_it_is_in_use(
    centre: Centre,
) -> None:
    first, unused = centre.publish(REVISION_5), centre.publish(REVISION_5.replace('"5"', '"6"'))
    centre.publish(REVISION_5)
    assert centre.given() == {first: ("A", "B")}
    facts = {"digest": first, "socket": "A", "name": "Battery 36 V", "revision": "5", "sha256": ""}
    centre.sender.bench.store.note(AuditEvent.RECIPE_USED, facts)
    event = withdraw(centre.central, first[:8], "wrong limits")
    assert (event.what, event.reason, event.by) == ("withdrawn", "wrong limits", PUBLISHER)
    assert centre.given() == {}
    assert centre.given() == {}
    assert centre.folder.given().withdrawn == {first}
    assert centre.folder.digests() == (first,)
    centre.sender.send()
    (status,) = centre.plant.status().recipes
    assert (status.socket, status.revision, status.is_withdrawn) == ("A", "5", True)
    assert status.published == ""
    centre.publish(REVISION_5)
    assert centre.given() == {first: ("A", "B")}
    assert not centre.plant.status().recipes[0].is_withdrawn
    with pytest.raises(UsageError, match="not the digest of one published recipe"):
        withdraw(centre.central, unused[:4], "typo")


def test_a_wrong_station_is_named_before_anything_is_stored(centre: Centre) -> None:
    with pytest.raises(UsageError, match="no station line-9: there are line-2, line-3"):
        centre.publish(REVISION_5, ("line-9",))
    assert centre.plant.rows("SELECT count(*) FROM released_file") == [(0,)]


def test_a_socket_that_a_station_does_not_have_is_named(centre: Centre) -> None:
    centre.publish(REVISION_5, ("line-2",), ("Z",))  # the plant does not know its sockets yet
    facts = {"digest": "", "socket": "A", "name": "Battery 36 V", "revision": "4", "sha256": ""}
    centre.sender.bench.store.note(AuditEvent.RECIPE_USED, facts)
    centre.sender.send()
    with pytest.raises(UsageError, match="line-2 has no socket Z: there is A"):
        centre.publish(REVISION_5, ("line-2",), ("A", "Z"))
    centre.publish(REVISION_5, ("line-2", "line-3"), ("A",))
    assert len(events_of(centre.central)) == 3


@pytest.mark.parametrize("linked", ["recipe.toml", "bms.bin", "bms.bin.toml"])
def test_a_link_is_named_and_not_published(centre: Centre, linked: str) -> None:
    write_recipe(centre.source, REVISION_5)
    file = centre.source / linked
    file.replace(centre.source / "elsewhere")
    file.symlink_to("elsewhere")
    loaded = load_checked(centre.source / "recipe.toml", DAY)
    with pytest.raises(UsageError, match=f"{linked} is a link"):
        publish(centre.central, loaded, (), (), DAY)


@pytest.mark.skipif(os.name == "nt", reason="no name of a file there")
def test_a_name_that_other_systems_read_otherwise_is_not_published(centre: Centre) -> None:
    make_recipe(centre.source, REVISION_5)
    for name in ("bms.bin", "bms.bin.toml"):
        (centre.source / name).replace(centre.source / f"x\\{name}")
    text = REVISION_5.replace('"bms.bin"', "'x\\bms.bin'")
    (centre.source / "recipe.toml").write_text(text, encoding="utf-8")
    loaded = load_checked(centre.source / "recipe.toml", DAY)
    with pytest.raises(UsageError, match="cannot be published"):
        publish(centre.central, loaded, (), (), DAY)


def test_a_revision_is_published_with_one_content(centre: Centre) -> None:
    digest = centre.publish(REVISION_5)
    withdraw(centre.central, digest, "wrong limits")
    other = REVISION_5 + "\n[lot]\nrequired = true\n"
    with pytest.raises(UsageError, match=f"revision 5, .* other content: {digest[:16]}"):
        centre.publish(other)
    assert centre.publish(REVISION_5) == digest
    centre.publish(other.replace('"5"', '"6"'))
    assert len(events_of(centre.central)) == 4


def test_two_publishers_at_one_moment_do_not_publish_two_contents(
    centre: Centre, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = make_recipe(centre.source, REVISION_5)
    (tmp_path / "other").mkdir()
    second = make_recipe(tmp_path / "other", REVISION_5 + "\n[lot]\nrequired = true\n")
    waiting = "SELECT count(*) FROM pg_locks WHERE NOT granted"
    check = recipes._check_revision
    with ThreadPoolExecutor() as pool:
        others: list[Future[Bundle]] = []

        def check_before_the_other(*args: Any) -> None:
            check(*args)
            if not others:
                others.append(pool.submit(publish, centre.central, second, (), (), DAY))
                while not others[0].done() and centre.plant.rows(waiting) == [(0,)]:
                    pass

        monkeypatch.setattr(recipes, "_check_revision", check_before_the_other)
        digest = publish(centre.central, first, (), (), DAY).digest
        with pytest.raises(UsageError, match=f"other content: {digest[:16]}"):
            others[0].result()
    assert [each.digest for each in events_of(centre.central)] == [digest]


def test_what_the_owner_of_the_database_alters_is_not_taken(centre: Centre) -> None:
    """Somebody with all rights on the database takes the rules away first."""
    good = centre.publish(REVISION_5)
    assert centre.given() == {good: ("A", "B")}
    bad = centre.publish(REVISION_5.replace('"5"', '"6"'))
    with centre.plant.connect() as owner:
        owner.execute("ALTER TABLE released_file DISABLE TRIGGER USER")
        owner.execute("ALTER TABLE released_file DROP CONSTRAINT file_is_whole")
        owner.execute("UPDATE released_file SET data = data || 'x'::bytea")
    (given,) = centre.fetcher.fetch().recipes
    assert (given.digest, "has another hash" in given.fault) == (bad, True)
    assert centre.folder.digests() == (good,), "the old one stays"
    assert not list(centre.folder.folder.glob(".part-*"))


def test_a_full_disk_leaves_the_old_recipe(centre: Centre, monkeypatch: pytest.MonkeyPatch) -> None:
    good = centre.publish(REVISION_5)
    assert centre.given() == {good: ("A", "B")}
    bad = centre.publish(REVISION_5.replace('"5"', '"6"'))

    def full(_handle: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patched:
        patched.setattr("flasher.station.given_recipes.os.fsync", full)
        with pytest.raises(RecordError, match="A recipe from the plant cannot be saved: No space"):
            centre.fetcher.fetch()
    assert centre.folder.digests() == (good,)
    assert centre.folder.given().recipes[0].digest == good
    assert not list(centre.folder.folder.glob(".part-*"))
    assert set(centre.given()) == {bad}


def test_a_connection_lost_between_two_pieces_leaves_nothing_half(
    centre: Centre, monkeypatch: pytest.MonkeyPatch
) -> None:
    digest = centre.publish(REVISION_5)
    pieces = centre.fetcher._pieces

    def broken(of: str, sha256: str) -> Iterator[bytes]:
        yield next(pieces(of, sha256))[:10]
        raise RecordError("The plant's database cannot be read: the server ended.")

    with monkeypatch.context() as patched:
        patched.setattr(centre.fetcher, "_pieces", broken)
        (given,) = centre.fetcher.fetch().recipes
    assert "the server ended" in given.fault
    assert centre.folder.digests() == ()
    assert centre.fetcher.fetch().new == (digest,)


def test_a_copy_that_has_not_changed_is_read_once_by_each_process(
    centre: Centre, monkeypatch: pytest.MonkeyPatch
) -> None:
    digest = centre.publish(REVISION_5)
    centre.fetcher.fetch()
    with monkeypatch.context() as patched:
        patched.setattr(given_recipes, "sha256_of", None)
        with pytest.raises(TypeError):
            centre.fetcher.fetch()
    centre.fetcher.fetch()
    with monkeypatch.context() as patched:
        patched.setattr(given_recipes, "sha256_of", None)
        assert centre.fetcher.fetch().new == ()
    image = centre.folder.folder / digest / "files" / "bms.bin"
    data = image.read_bytes()
    image.write_bytes(data[::-1])
    assert centre.fetcher.fetch().new == (digest,), "of the same size"
    assert image.read_bytes() == data
    assert centre.fetcher.fetch().new == ()
    before = image.stat()
    image.write_bytes(data[::-1])
    os.utime(image, ns=(before.st_atime_ns, before.st_mtime_ns))
    assert not RecipeFolder(centre.folder.folder).is_whole(digest), "a new process reads it"
    assert centre.fetcher.fetch().new == ()
    with pytest.raises(UsageError, match="copy of a recipe from the plant is damaged"):
        RecipeFolder(centre.folder.folder).load(digest, DAY)
    assert centre.fetcher.fetch().new == (digest,), "which a socket could not use"


def test_a_damaged_copy_is_fetched_again(centre: Centre) -> None:
    used = centre.publish(REVISION_5)
    centre.fetcher.fetch()
    facts = {"digest": used, "socket": "A", "name": "Battery 36 V", "revision": "5", "sha256": ""}
    centre.sender.bench.store.note(AuditEvent.RECIPE_USED, facts)
    newest = centre.publish(REVISION_5.replace('"5"', '"6"'))
    centre.fetcher.fetch()
    for digest in (newest, used):
        image = centre.folder.folder / digest / "files" / "bms.bin"
        image.write_bytes(image.read_bytes()[:-1])
    assert set(centre.fetcher.fetch().new) == {newest, used}
    assert centre.folder.is_whole(newest)
    assert centre.folder.is_whole(used), "the next start needs it, although a newer one is there"


def test_a_recipe_in_use_that_is_lost_and_not_given_any_more_is_reported(centre: Centre) -> None:
    facts = {"digest": "0" * 64, "socket": "A", "name": "", "revision": "5", "sha256": ""}
    centre.sender.bench.store.note(AuditEvent.RECIPE_USED, facts)
    newest = centre.publish(REVISION_5)
    with pytest.raises(RecordError, match="0000000000000000"):
        centre.fetcher.fetch()
    assert [each.digest for each in centre.folder.given().recipes] == [newest]


def test_a_socket_that_is_no_longer_there_needs_no_recipe(centre: Centre) -> None:
    facts = {"digest": "0" * 64, "socket": "C", "name": "", "revision": "5", "sha256": ""}
    centre.sender.bench.store.note(AuditEvent.RECIPE_USED, facts)
    newest = centre.publish(REVISION_5)
    assert centre.given() == {newest: ("A", "B")}


def test_a_list_that_cannot_be_read_is_written_again(centre: Centre) -> None:
    newest = centre.publish(REVISION_5)
    centre.fetcher.fetch()
    (centre.folder.folder / "given.json").write_text('{"recipes": [', encoding="utf-8")
    with pytest.raises(RecordError, match="cannot be read"):
        centre.folder.given()
    assert centre.given() == {newest: ("A", "B")}
    assert centre.folder.given().recipes[0].digest == newest


def test_a_file_without_end_is_refused(centre: Centre, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("flasher.plant.fetcher.FILE_MAX_SIZE", 100)
    centre.publish(REVISION_5)
    (given,) = centre.fetcher.fetch().recipes
    assert "larger than 100 bytes" in given.fault
    assert centre.folder.digests() == ()


def test_large_files_come_in_pieces(centre: Centre) -> None:
    data = random.Random(1).randbytes(2 * PIECE_BYTES + 10)
    bundle = Bundle("recipe.toml", {"recipe.toml": hashlib.sha256(data).hexdigest()})
    (sha256,) = bundle.files.values()
    with centre.plant.connect(PUBLISHER) as publisher:
        publisher.execute("INSERT INTO released_file VALUES (%s, %s)", [sha256, data])
        publisher.execute(
            "INSERT INTO released_recipe (digest, manifest, name, revision, part)"
            " VALUES (%s, %s, '', '', '')",
            [bundle.digest, bundle.to_text()],
        )
        publisher.execute(
            "INSERT INTO recipe_event (what, digest) VALUES ('published', %s)", [bundle.digest]
        )
    pieces = list(centre.fetcher._pieces(bundle.digest, sha256))
    assert list(map(len, pieces)) == [PIECE_BYTES, PIECE_BYTES, 10]
    assert b"".join(pieces) == data


def test_a_station_sees_only_what_is_given_to_it(centre: Centre) -> None:
    theirs = centre.publish(REVISION_5, ("line-3",))
    assert centre.given() == {}
    sha256 = bundle_of(make_recipe(centre.source, REVISION_5)).files["bms.bin"]
    with centre.plant.connect("flasher_line_2") as station:
        (manifest,) = _one(station, "SELECT plant_recipe_manifest(%s)", theirs)
        (piece,) = _one(station, "SELECT plant_recipe_piece(%s, %s, 0)", theirs, sha256)
    assert (manifest, piece) == (None, None)


def _one(connection: psycopg.Connection[Any], query: str, *values: str) -> tuple[Any, ...]:
    found: tuple[Any, ...] | None = connection.execute(query.encode(), values).fetchone()
    assert found is not None
    return found


@pytest.mark.parametrize("user", ["publisher", "owner"])
@pytest.mark.parametrize(
    "statement",
    [
        "UPDATE recipe_event SET by = 'bert'",
        "DELETE FROM recipe_event",
        "TRUNCATE recipe_event",
        "UPDATE released_recipe SET name = 'x'",
        "DELETE FROM released_file",
    ],
)
def test_what_was_published_is_not_changed(centre: Centre, statement: str, user: str) -> None:
    centre.publish(REVISION_5)
    role = PUBLISHER if user == "publisher" else "postgres"
    with centre.plant.connect(role) as connection, pytest.raises(psycopg.Error) as caught:
        connection.execute(statement.encode())
    assert caught.value.sqlstate == "42501"


def test_a_publisher_cannot_state_another_name_or_time(centre: Centre) -> None:
    digest = centre.publish(REVISION_5)
    for column, value in (("by", "'bert'"), ("at", "now()")):
        with (
            centre.plant.connect(PUBLISHER) as connection,
            pytest.raises(psycopg.errors.InsufficientPrivilege),
        ):
            connection.execute(
                f"INSERT INTO recipe_event (what, digest, {column}) VALUES ('published',"
                f" '{digest}', {value})".encode()
            )


def test_a_database_of_the_first_revision_is_brought_up_to_date(plant: Plant) -> None:
    make_old(plant, 1)
    setup(plant.url(), STATIONS, datetime.now(UTC))
    with closing(Central(plant.url())) as central:
        digest = publish(central, make_recipe(plant.folder), (), (), DAY).digest
        assert [each.digest for each in events_of(central)] == [digest]
    with plant.connect() as owner, pytest.raises(psycopg.errors.InsufficientPrivilege):
        owner.execute("DELETE FROM recipe_event")
