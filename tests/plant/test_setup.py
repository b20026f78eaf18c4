"""`setup` makes the database and the roles, once, and brings what is there up to date."""

from __future__ import annotations

from datetime import UTC, datetime

import pytest

from flasher.errors import UsageError
from flasher.plant.schema import PLANT_SCHEMA
from flasher.plant.setup import StationRole, create_database, role_of, setup
from tests.plant.factory import Plant
from tests.station.postgres import Server

NOW = datetime(2026, 5, 17, tzinfo=UTC)


def test_it_creates_the_database_once_and_a_role_for_each_station(postgres: Server) -> None:
    url = postgres.url("plant_new")
    assert create_database(url)
    assert not create_database(url)
    made = setup(url, ["Line 7"], NOW)
    role = StationRole("flasher_line_7", "Line 7")
    assert (made.before, made.created, made.stations) == (None, (role,), (role,))
    again = setup(url, ["Line 7"], NOW)
    assert (again.before, again.created, again.stations) == (PLANT_SCHEMA, (), (role,))


def test_a_user_who_may_not_create_it_learns_what_to_do(plant: Plant) -> None:
    url = plant.url("flasher_line_2").replace(plant.database, "plant_other")
    with pytest.raises(UsageError, match="may not create it") as caught:
        create_database(url)
    assert "--print" in str(caught.value)


def test_a_database_with_other_data_is_left_alone(postgres: Server) -> None:
    name = postgres.database()
    with postgres.connect(name) as connection:
        connection.execute("CREATE TABLE orders (id int)")
    with pytest.raises(UsageError, match="holds other data"):
        setup(postgres.url(name), [], NOW)


def test_a_newer_database_is_refused(plant: Plant) -> None:
    with plant.connect() as connection:
        connection.execute("UPDATE plant_version SET version_num = '99'")
    with pytest.raises(UsageError, match="schema 99"):
        setup(plant.url(), [], NOW)


def test_two_stations_never_share_a_role(plant: Plant) -> None:
    with pytest.raises(UsageError, match="would have the role flasher_line_2"):
        setup(plant.url(), ["LINE 2"], NOW)


@pytest.mark.parametrize("name", ["stations", "Readers", "deliverers"])
def test_a_station_is_not_called_like_a_role_of_all(plant: Plant, name: str) -> None:
    with pytest.raises(UsageError, match=f"cannot be called {name}"):
        setup(plant.url(), [name], NOW)


@pytest.mark.parametrize("grant", ["ALTER ROLE {} CREATEROLE", "GRANT flasher_readers TO {}"])
def test_a_station_never_has_more_rights(plant: Plant, grant: str) -> None:
    role = role_of("line-2")
    undo = grant.replace("CREATEROLE", "NOCREATEROLE").replace("GRANT", "REVOKE")
    undo = undo.replace(" TO ", " FROM ")
    with plant.connect() as connection:
        connection.autocommit = True
        connection.execute(grant.format(role).encode())
        try:
            with pytest.raises(UsageError, match="more rights"):
                setup(plant.url(), ["line-2"], NOW)
        finally:
            connection.execute(undo.format(role).encode())


def test_public_has_no_rights(plant: Plant) -> None:
    found = plant.rows(
        "SELECT relname FROM pg_class WHERE relnamespace = 'public'::regnamespace"
        " AND relkind IN ('r', 'v') AND EXISTS (SELECT FROM aclexplode(relacl) WHERE grantee = 0)"
    )
    assert found == []
