# ruff: noqa: S608  all of this SQL is written here
"""SQL functions and rights for recipes that the plant gives out.

A station may execute three functions, which show it what is published for it and nothing else.
Members of `flasher_publishers` add rows, which are never changed or deleted; the database states
who added each one, and when.
"""

from __future__ import annotations

from typing import Final

from flasher.plant.functions import DEFINER, REFUSED

PIECE_BYTES: Final = 1 << 20
"""Size of the pieces in which a station fetches a file: each has a time limit of its own."""

_MINE: Final = f"""
CREATE OR REPLACE FUNCTION plant_gives_me(of_digest text) RETURNS boolean LANGUAGE sql STABLE
{DEFINER} AS $$
    SELECT EXISTS (SELECT FROM recipe_event e JOIN plant_station p ON p.role = session_user
        WHERE e.what = 'published' AND e.digest = of_digest
        AND (e.station IS NULL OR e.station = p.name))
$$
"""

_RECIPES: Final = f"""
CREATE OR REPLACE FUNCTION plant_recipes(held text[]) RETURNS jsonb LANGUAGE plpgsql STABLE
{DEFINER} AS $$
DECLARE
    mine text := (SELECT name FROM plant_station WHERE role = session_user);
    published jsonb;
    withdrawn jsonb;
BEGIN
    IF mine IS NULL THEN
        RAISE EXCEPTION 'foreign: the user % is not the user of a station', session_user
            USING ERRCODE = '{REFUSED}';
    END IF;
    SELECT coalesce(jsonb_agg(to_jsonb(x)), '[]') INTO published FROM (
        SELECT DISTINCT ON (socket) id, socket, digest, at, by FROM recipe_event
        WHERE what = 'published' AND (station IS NULL OR station = mine)
        ORDER BY socket, id DESC) x;
    SELECT coalesce(jsonb_agg(digest), '[]') INTO withdrawn FROM (
        SELECT DISTINCT ON (digest) digest, what FROM recipe_event
        WHERE digest = ANY (held) OR digest IN (SELECT jsonb_array_elements(published)->>'digest')
        ORDER BY digest, id DESC) x WHERE what = 'withdrawn' AND plant_gives_me(digest);
    RETURN jsonb_build_object('published', published, 'withdrawn', withdrawn);
END $$
"""
"""The newest recipe for each socket of a station (null: all sockets), and which of these and of the
ones that it holds are withdrawn."""

_MANIFEST: Final = f"""
CREATE OR REPLACE FUNCTION plant_recipe_manifest(of_digest text) RETURNS text LANGUAGE sql STABLE
{DEFINER} AS $$
    SELECT manifest FROM released_recipe WHERE digest = of_digest AND plant_gives_me(digest)
$$
"""

_PIECE: Final = f"""
CREATE OR REPLACE FUNCTION plant_recipe_piece(of_digest text, of_sha256 text, start bigint)
RETURNS bytea LANGUAGE sql STABLE {DEFINER} AS $$
    SELECT substring(f.data FROM start::integer + 1 FOR {PIECE_BYTES}) FROM released_file f
        WHERE f.sha256 = of_sha256 AND plant_gives_me(of_digest)
        AND EXISTS (SELECT FROM released_recipe r, json_each_text(r.manifest::json->'files') each
            WHERE r.digest = of_digest AND each.value = of_sha256)
$$
"""

_STAY: Final = """
CREATE OR REPLACE FUNCTION plant_stays() RETURNS trigger LANGUAGE plpgsql AS $$
BEGIN
    RAISE EXCEPTION 'rows of % are not changed or deleted', TG_TABLE_NAME
        USING ERRCODE = 'insufficient_privilege';
END $$
"""

FUNCTIONS: Final = (_MINE, _RECIPES, _MANIFEST, _PIECE, _STAY)
_TABLES: Final = ("released_file", "released_recipe", "recipe_event")
_STAYS: Final = "".join(
    f"CREATE OR REPLACE TRIGGER {table}_stays BEFORE UPDATE OR DELETE OR TRUNCATE ON {table}"
    " FOR EACH STATEMENT EXECUTE FUNCTION plant_stays();"
    for table in _TABLES
)


def rights(stations: str, readers: str, publishers: str) -> str:
    """Statements that give the roles exactly their rights, after `functions.rights`; names are
    quoted.
    """
    return f"""
{_STAYS}
REVOKE ALL ON ALL TABLES IN SCHEMA public FROM {publishers};
REVOKE ALL ON ALL FUNCTIONS IN SCHEMA public FROM {publishers};
GRANT {readers} TO {publishers};
GRANT EXECUTE ON FUNCTION plant_recipes(text[]), plant_recipe_manifest(text),
    plant_recipe_piece(text, text, bigint) TO {stations};
GRANT INSERT ON released_file TO {publishers};
GRANT INSERT (digest, manifest, name, revision, part) ON released_recipe TO {publishers};
GRANT INSERT (what, digest, station, socket, reason) ON recipe_event TO {publishers};
"""
