CREATE FUNCTION public.plant_add_run(own jsonb, shared jsonb) RETURNS bigint
    LANGUAGE plpgsql SECURITY DEFINER
    SET search_path TO 'public', 'pg_temp'
    AS $$
DECLARE
    r run := jsonb_populate_record(NULL::run, own->'run');
    images bigint[];
    here bigint;
BEGIN
    -- Looked up here first: their plans are cached, those of plant_named are made each time.
    SELECT id INTO here FROM station WHERE name = shared->'station'->>'name';
    here := coalesce(here, plant_named('station', '{name}', shared->'station'));
    SELECT id INTO r.socket_id FROM socket
        WHERE station_id = here AND name = shared->'socket'->>'name';
    IF r.socket_id IS NULL THEN
        r.socket_id := plant_named('socket', '{station_id,name}',
            (shared->'socket') || jsonb_build_object('station_id', here));
    END IF;
    SELECT id INTO r.unit_id FROM unit
        WHERE part = own->'unit'->>'part' AND serial = own->'unit'->>'serial';
    r.unit_id := coalesce(r.unit_id, plant_named('unit', '{part,serial}', own->'unit'));
    SELECT id INTO r.operator_id FROM operator WHERE name = shared->'operator'->>'name';
    r.operator_id := coalesce(r.operator_id,
        plant_named('operator', '{name}', shared->'operator'));
    SELECT id INTO r.lot_id FROM lot
        WHERE part = shared->'lot'->>'part' AND name = shared->'lot'->>'name';
    r.lot_id := coalesce(r.lot_id, plant_named('lot', '{part,name}', shared->'lot'));
    SELECT t.id INTO r.recipe_id FROM recipe t,
        jsonb_populate_record(NULL::recipe, shared->'recipe') k
        WHERE t.sha256 = k.sha256 AND t.name = k.name AND t.revision = k.revision
        AND t.part = k.part AND t.verification_required = k.verification_required
        AND t.allow_completed_not_read_back = k.allow_completed_not_read_back
        AND t.content = k.content;
    r.recipe_id := coalesce(r.recipe_id, plant_named('recipe', '{name,revision,part,sha256,'
        'content,verification_required,allow_completed_not_read_back}', shared->'recipe'));
    SELECT array_agg(coalesce((SELECT t.id FROM artifact t,
            jsonb_populate_record(NULL::artifact, each) k
            WHERE t.sha256 = k.sha256 AND t.target = k.target AND t.name = k.name
            AND t.version = k.version AND t.size_bytes = k.size_bytes),
            plant_named('artifact', '{target,name,version,sha256,size_bytes}', each))
        ORDER BY at) INTO images FROM jsonb_array_elements(shared->'artifacts')
        WITH ORDINALITY AS x(each, at);
    r.id := floor(extract(epoch FROM r.begun_at::timestamptz) * 1000000);
    LOOP
        BEGIN
            INSERT INTO run SELECT r.*;
            EXIT;
        EXCEPTION WHEN unique_violation THEN r.id := r.id + 1;
        END;
    END LOOP;
    INSERT INTO run_target (run_id, artifact_id, position, target, required, reached)
        SELECT r.id, images[at], t.position, t.target, t.required, t.reached
        FROM jsonb_array_elements(own->'targets') WITH ORDINALITY AS x(each, at),
            jsonb_populate_record(NULL::run_target, each) t ORDER BY at;
    WITH s AS (SELECT * FROM jsonb_populate_recordset(NULL::step, own->'steps')),
        added AS (
            INSERT INTO step (run_id, position, name, try_number, state, code, text, begun_at,
                begun_monotonic_s, duration_s)
            SELECT r.id, position, name, try_number, state, code, text, begun_at,
                begun_monotonic_s, duration_s FROM s ORDER BY position
            RETURNING step.id, step.position
        )
    INSERT INTO measurement (step_id, name, value, unit, low, high, text, expected)
        SELECT added.id, m.name, m.value, m.unit, m.low, m.high, m.text, m.expected
        FROM jsonb_populate_recordset(NULL::measurement, own->'measurements') m
            JOIN s ON s.id = m.step_id JOIN added ON added.position = s.position ORDER BY m.id;
    INSERT INTO device_write (run_id, target, what, value, intended_at, intended_monotonic_s,
            verified_at, read_back)
        SELECT r.id, target, what, value, intended_at, intended_monotonic_s, verified_at, read_back
        FROM jsonb_populate_recordset(NULL::device_write, own->'writes') ORDER BY id;
    INSERT INTO attachment (run_id, kind, name, sha256, size_bytes)
        SELECT r.id, kind, name, sha256, size_bytes
        FROM jsonb_populate_recordset(NULL::attachment, own->'attachments') ORDER BY id;
    RETURN r.id;
END $$;

ALTER FUNCTION public.plant_add_run(own jsonb, shared jsonb) OWNER TO postgres;

CREATE FUNCTION public.plant_bring() RETURNS trigger
    LANGUAGE plpgsql SECURITY DEFINER
    SET search_path TO 'public', 'pg_temp'
    AS $$
DECLARE
    mine plant_station;
    head chain_row;
    stated jsonb;
    own jsonb;
    shared jsonb := '{}';
    part text;
    body text;
    refusal text;
BEGIN
    SELECT * INTO mine FROM plant_station WHERE role = session_user FOR UPDATE;
    IF mine.station IS DISTINCT FROM NEW.station OR NEW.station IS NULL THEN
        RAISE EXCEPTION 'foreign: the user % does not send this chain', session_user
            USING ERRCODE = 'FL001';
    END IF;
    SELECT * INTO head FROM chain_row WHERE station = NEW.station ORDER BY number DESC LIMIT 1;
    IF NEW.number <= head.number THEN
        IF EXISTS (SELECT FROM chain_row c WHERE c.station = NEW.station
                AND c.number = NEW.number AND c.hash = NEW.hash) THEN
            RETURN NULL;  -- it was sent before
        END IF;
        refusal := format('forked: row %s is here with another hash', NEW.number);
    ELSIF NEW.number <> coalesce(head.number, 0) + 1 THEN
        refusal := format('incomplete: row %s does not follow row %s', NEW.number,
            coalesce(head.number, 0));
    ELSIF NEW.previous_hash <> coalesce(head.hash, repeat('0', 64)) THEN
        refusal := format('forked: row %s does not continue the chain', NEW.number);
    ELSIF NEW.hash <> encode(sha256(convert_to(
            '["' || NEW.previous_hash || '",' || NEW.number || ',' || to_json(NEW.at) || ','
            || to_json(NEW.event) || ',' || coalesce(NEW.run_number::text, 'null') || ','
            || to_json(NEW.data) || ']', 'UTF8')), 'hex') THEN
        refusal := format('edited: row %s does not have its hash', NEW.number);
    ELSIF NEW.number = 1 AND (NEW.event <> 'begun' OR NEW.data::jsonb->>'station' <> mine.name
            OR NEW.data::jsonb->>'records' <> mine.records_id) THEN
        refusal := 'foreign: the chain begins with another station or other records';
    ELSIF (NEW.content IS NOT NULL) <> (NEW.event IN ('finished', 'interrupted')) THEN
        refusal := format('edited: row %s has not the content of its kind', NEW.number);
    END IF;
    IF refusal IS NOT NULL THEN
        RAISE EXCEPTION '%', refusal USING ERRCODE = 'FL001';
    END IF;
    NEW.arrived_at := clock_timestamp();
    SELECT id INTO NEW.station_id FROM station WHERE name = mine.name;
    NEW.station_id := coalesce(NEW.station_id,
        plant_named('station', '{name}', jsonb_build_object('name', mine.name)));
    IF NEW.content IS NULL THEN
        IF NEW.run_number IS NOT NULL THEN
            SELECT run_id INTO NEW.run_id FROM chain_row WHERE station = NEW.station
                AND run_number = NEW.run_number AND content IS NOT NULL;
        END IF;
        RETURN NEW;
    END IF;
    IF EXISTS (SELECT FROM chain_row WHERE station = NEW.station
            AND run_number = NEW.run_number AND content IS NOT NULL) THEN
        RAISE EXCEPTION 'edited: run % ended twice', NEW.run_number USING ERRCODE = 'FL001';
    END IF;
    stated := NEW.data::jsonb->'digests';
    FOREACH part IN ARRAY ARRAY['run', 'unit', 'targets', 'steps', 'measurements', 'writes', 'attachments'] LOOP
        body := (NEW.content->part)::text;
        IF body IS NULL OR encode(sha256(convert_to(body, 'UTF8')), 'hex')
                IS DISTINCT FROM stated->>part THEN
            RAISE EXCEPTION 'edited: % of run %, row %', part, NEW.run_number, NEW.number
                USING ERRCODE = 'FL001';
        END IF;
    END LOOP;
    own := NEW.content::jsonb;
    FOREACH part IN ARRAY ARRAY['station', 'socket', 'operator', 'lot', 'recipe', 'artifacts'] LOOP
        SELECT content INTO body FROM shared_part
            WHERE station = NEW.station AND sha256 = stated->>part;
        IF NOT FOUND THEN
            RAISE EXCEPTION 'edited: % of run %, row %', part, NEW.run_number, NEW.number
                USING ERRCODE = 'FL001';
        END IF;
        shared := shared || jsonb_build_object(part, body::jsonb);
    END LOOP;
    IF (own->'run'->>'id')::bigint <> NEW.run_number OR own->'run'->>'state' = 'RUNNING'
            OR shared->'station'->>'name' <> mine.name THEN
        RAISE EXCEPTION 'edited: row % is not of run %', NEW.number, NEW.run_number
            USING ERRCODE = 'FL001';
    END IF;
    NEW.run_id := plant_add_run(own, shared);
    UPDATE chain_row SET run_id = NEW.run_id
        WHERE station = NEW.station AND run_number = NEW.run_number;
    RETURN NEW;
END $$;

ALTER FUNCTION public.plant_bring() OWNER TO postgres;

CREATE FUNCTION public.plant_claim(of_token text, of_part text, of_serial text, of_virtual boolean, at_socket text, lease_s double precision, OUT state text, OUT station text, OUT socket text, OUT at timestamp with time zone, OUT run bigint) RETURNS record
    LANGUAGE plpgsql SECURITY DEFINER
    SET search_path TO 'public', 'pg_temp'
    AS $$
DECLARE
    mine plant_station;
    other plant_claim;
    now timestamptz;
BEGIN
    SELECT * INTO mine FROM plant_station p WHERE p.role = session_user;
    IF mine.station IS NULL THEN
        RAISE EXCEPTION 'foreign: the user % has not sent from any records', session_user
            USING ERRCODE = 'FL001';
    END IF;
    PERFORM pg_advisory_xact_lock(hashtextextended(of_part || E'\x1f' || of_serial, 7053));
    now := clock_timestamp();
    -- Claims before runs: a claim goes when the end of its run comes.
    SELECT * INTO other FROM plant_claim c WHERE c.part = of_part AND c.serial = of_serial
        AND c.station <> mine.station ORDER BY c.expires_at DESC LIMIT 1;
    IF other.expires_at > now THEN
        state := 'running';
    ELSE
        SELECT 'passed', n.name, s.name, r.begun_at::timestamptz, c.run_number
            INTO state, station, socket, at, run
            FROM unit u JOIN run r ON r.unit_id = u.id
                JOIN chain_row c ON c.run_id = r.id AND c.content IS NOT NULL
                JOIN socket s ON s.id = r.socket_id JOIN station n ON n.id = s.station_id
            WHERE u.part = of_part AND u.serial = of_serial AND r.state = 'PASS'
                AND r.kind <> 'golden' AND r.is_virtual = of_virtual
                AND c.station <> mine.station
            ORDER BY r.id DESC LIMIT 1;
        IF state IS NULL AND other.token IS NOT NULL THEN
            state := 'unknown';
        END IF;
    END IF;
    IF state IN ('running', 'unknown') THEN
        SELECT p.name, other.socket, other.claimed_at INTO station, socket, at
            FROM plant_station p WHERE p.station = other.station;
    END IF;
    IF state IS DISTINCT FROM 'running' THEN
        IF (SELECT count(*) FROM plant_claim c WHERE c.station = mine.station
                AND c.expires_at > now) >= 1000 THEN
            RAISE EXCEPTION 'foreign: station % claims too many units', mine.name
                USING ERRCODE = 'FL001';
        END IF;
        INSERT INTO plant_claim (token, station, part, serial, socket, claimed_at, expires_at)
            VALUES (of_token, mine.station, of_part, of_serial, at_socket, now,
                now + make_interval(secs => greatest(1, least(lease_s, 600))));
    END IF;
END $$;

ALTER FUNCTION public.plant_claim(of_token text, of_part text, of_serial text, of_virtual boolean, at_socket text, lease_s double precision, OUT state text, OUT station text, OUT socket text, OUT at timestamp with time zone, OUT run bigint) OWNER TO postgres;

CREATE FUNCTION public.plant_claims() RETURNS TABLE(token text, part text, serial text)
    LANGUAGE sql STABLE SECURITY DEFINER
    SET search_path TO 'public', 'pg_temp'
    AS $$
    SELECT token, part, serial FROM plant_claim WHERE station = plant_my_station()
$$;

ALTER FUNCTION public.plant_claims() OWNER TO postgres;

CREATE FUNCTION public.plant_end_claims() RETURNS trigger
    LANGUAGE plpgsql SECURITY DEFINER
    SET search_path TO 'public', 'pg_temp'
    AS $$
DECLARE
    ended run;
BEGIN
    DELETE FROM plant_claim WHERE station = NEW.station AND token IN (
        SELECT m.text FROM step s JOIN measurement m ON m.step_id = s.id
        WHERE s.run_id = NEW.run_id AND s.position = 1 AND s.name = 'plant'
            AND m.name = 'plant claim');
    SELECT * INTO ended FROM run WHERE id = NEW.run_id;
    IF ended.state = 'PASS' AND ended.kind IN ('production', 'recheck') THEN
        INSERT INTO plant_pass (unit_id, is_virtual, run_id, station)
            VALUES (ended.unit_id, ended.is_virtual, ended.id, NEW.station) ON CONFLICT DO NOTHING;
        IF NOT FOUND THEN
            INSERT INTO plant_duplicate (run_id, first_run_id)
                SELECT ended.id, p.run_id FROM plant_pass p WHERE p.unit_id = ended.unit_id
                    AND p.is_virtual = ended.is_virtual AND p.station <> NEW.station;
        END IF;
    END IF;
    RETURN NULL;
END $$;

ALTER FUNCTION public.plant_end_claims() OWNER TO postgres;

CREATE FUNCTION public.plant_enter(of_records text, called text, OUT station uuid, OUT head_number bigint, OUT head_hash text, OUT now timestamp with time zone) RETURNS record
    LANGUAGE plpgsql SECURITY DEFINER
    SET search_path TO 'public', 'pg_temp'
    AS $$
DECLARE
    mine plant_station;
    wanted uuid := left(encode(sha256(convert_to(of_records || ' ' || called, 'UTF8')), 'hex'), 32);
BEGIN
    SELECT * INTO mine FROM plant_station p WHERE p.role = session_user FOR UPDATE;
    IF NOT FOUND OR mine.name <> called THEN
        RAISE EXCEPTION 'foreign: the user % is not the user of station %', session_user, called
            USING ERRCODE = 'FL001';
    END IF;
    IF mine.station IS NULL THEN
        UPDATE plant_station p SET station = wanted, records_id = of_records, entered_at = now()
            WHERE p.role = session_user;
    ELSIF mine.station <> wanted THEN
        RAISE EXCEPTION 'foreign: station % sends from other records, those with id %', called,
            mine.records_id USING ERRCODE = 'FL001';
    END IF;
    station := wanted;
    now := clock_timestamp();
    SELECT c.number, c.hash INTO head_number, head_hash FROM chain_row c
        WHERE c.station = wanted ORDER BY c.number DESC LIMIT 1;
    head_number := coalesce(head_number, 0);
    head_hash := coalesce(head_hash, repeat('0', 64));
END $$;

ALTER FUNCTION public.plant_enter(of_records text, called text, OUT station uuid, OUT head_number bigint, OUT head_hash text, OUT now timestamp with time zone) OWNER TO postgres;

CREATE FUNCTION public.plant_my_station() RETURNS uuid
    LANGUAGE sql STABLE SECURITY DEFINER
    SET search_path TO 'public', 'pg_temp'
    AS $$
    SELECT station FROM plant_station WHERE role = session_user
$$;

ALTER FUNCTION public.plant_my_station() OWNER TO postgres;

CREATE FUNCTION public.plant_named(in_table text, names text[], key jsonb) RETURNS bigint
    LANGUAGE plpgsql SECURITY DEFINER
    SET search_path TO 'public', 'pg_temp'
    AS $_$
DECLARE
    found bigint;
    columns text := (SELECT string_agg(quote_ident(n), ', ') FROM unnest(names) n);
    same text := (SELECT string_agg(format('t.%1$I = k.%1$I', n), ' AND ') FROM unnest(names) n);
    find text := format('SELECT t.id FROM %1$I t, jsonb_populate_record(NULL::%1$I, $1) k WHERE ',
        in_table) || same;
BEGIN
    IF jsonb_typeof(key) <> 'object' THEN RETURN NULL; END IF;
    EXECUTE find INTO found USING key;
    IF found IS NULL THEN
        EXECUTE format('INSERT INTO %1$I (%2$s) SELECT %2$s FROM'
            ' jsonb_populate_record(NULL::%1$I, $1) ON CONFLICT DO NOTHING', in_table, columns)
            USING key;
        EXECUTE find INTO found USING key;
    END IF;
    RETURN found;
END $_$;

ALTER FUNCTION public.plant_named(in_table text, names text[], key jsonb) OWNER TO postgres;

CREATE FUNCTION public.plant_release(tokens text[]) RETURNS void
    LANGUAGE sql SECURITY DEFINER
    SET search_path TO 'public', 'pg_temp'
    AS $$
    DELETE FROM plant_claim WHERE token = ANY(tokens) AND station = plant_my_station()
$$;

ALTER FUNCTION public.plant_release(tokens text[]) OWNER TO postgres;

CREATE FUNCTION public.plant_renew(tokens text[], lease_s double precision) RETURNS void
    LANGUAGE sql SECURITY DEFINER
    SET search_path TO 'public', 'pg_temp'
    AS $$
    UPDATE plant_claim SET expires_at = clock_timestamp()
            + make_interval(secs => greatest(1, least(lease_s, 600)))
        WHERE token = ANY(tokens) AND station = plant_my_station()
$$;

ALTER FUNCTION public.plant_renew(tokens text[], lease_s double precision) OWNER TO postgres;

CREATE FUNCTION public.plant_report(reporting text, is_unsent bigint, oldest text, offset_s double precision, free_bytes bigint, refused text) RETURNS void
    LANGUAGE sql SECURITY DEFINER
    SET search_path TO 'public', 'pg_temp'
    AS $$
    UPDATE plant_station SET reported_at = clock_timestamp(), version = left(reporting, 100),
        unsent = is_unsent, oldest_unsent_at = left(oldest, 27), clock_offset_s = offset_s,
        disk_free_bytes = free_bytes, refusal = left(refused, 1000)
    WHERE role = session_user
$$;

ALTER FUNCTION public.plant_report(reporting text, is_unsent bigint, oldest text, offset_s double precision, free_bytes bigint, refused text) OWNER TO postgres;

CREATE TABLE public.alembic_version (
    version_num character varying(32) NOT NULL
);

ALTER TABLE public.alembic_version OWNER TO postgres;

CREATE TABLE public.artifact (
    id bigint NOT NULL,
    target character varying(16) NOT NULL,
    name character varying(200) NOT NULL,
    version character varying(64) NOT NULL,
    sha256 character varying(64) NOT NULL,
    size_bytes bigint NOT NULL,
    CONSTRAINT sha256_is_whole CHECK ((length((sha256)::text) = 64))
);

ALTER TABLE public.artifact OWNER TO postgres;

CREATE SEQUENCE public.artifact_id_seq
    START WITH 1
    INCREMENT BY 1
    NO MINVALUE
    NO MAXVALUE
    CACHE 1;

ALTER TABLE public.artifact_id_seq OWNER TO postgres;

ALTER SEQUENCE public.artifact_id_seq OWNED BY public.artifact.id;

CREATE TABLE public.attachment (
    id bigint NOT NULL,
    run_id bigint NOT NULL,
    kind character varying(32) NOT NULL,
    name character varying(200) NOT NULL,
    sha256 character varying(64) NOT NULL,
    size_bytes bigint NOT NULL,
    CONSTRAINT sha256_is_whole CHECK ((length((sha256)::text) = 64))
);

ALTER TABLE public.attachment OWNER TO postgres;

CREATE SEQUENCE public.attachment_id_seq
    START WITH 1
    INCREMENT BY 1
    NO MINVALUE
    NO MAXVALUE
    CACHE 1;

ALTER TABLE public.attachment_id_seq OWNER TO postgres;

ALTER SEQUENCE public.attachment_id_seq OWNED BY public.attachment.id;

CREATE TABLE public.chain_row (
    id bigint NOT NULL,
    station uuid NOT NULL,
    number bigint NOT NULL,
    at text NOT NULL,
    event text NOT NULL,
    run_number bigint,
    data text NOT NULL,
    previous_hash text NOT NULL,
    hash text NOT NULL,
    signature text NOT NULL,
    content json,
    arrived_at timestamp with time zone DEFAULT now() NOT NULL,
    station_id bigint,
    run_id bigint
);

ALTER TABLE public.chain_row OWNER TO postgres;

CREATE VIEW public.audit AS
 SELECT chain_row.id,
    chain_row.station_id,
    chain_row.number,
    chain_row.at,
    chain_row.event,
    chain_row.run_id,
    chain_row.data,
    chain_row.previous_hash,
    chain_row.hash,
    chain_row.signature
   FROM public.chain_row;

ALTER TABLE public.audit OWNER TO postgres;

ALTER TABLE public.chain_row ALTER COLUMN id ADD GENERATED ALWAYS AS IDENTITY (
    SEQUENCE NAME public.chain_row_id_seq
    START WITH 1
    INCREMENT BY 1
    NO MINVALUE
    NO MAXVALUE
    CACHE 1
);

CREATE TABLE public.device_write (
    id bigint NOT NULL,
    run_id bigint NOT NULL,
    target character varying(16) NOT NULL,
    what character varying(64) NOT NULL,
    value text NOT NULL,
    intended_at character varying(27) NOT NULL,
    intended_monotonic_s double precision NOT NULL,
    verified_at character varying(27),
    read_back text,
    CONSTRAINT read_back_is_verified CHECK (((read_back IS NULL) OR (verified_at IS NOT NULL)))
);

ALTER TABLE public.device_write OWNER TO postgres;

CREATE SEQUENCE public.device_write_id_seq
    START WITH 1
    INCREMENT BY 1
    NO MINVALUE
    NO MAXVALUE
    CACHE 1;

ALTER TABLE public.device_write_id_seq OWNER TO postgres;

ALTER SEQUENCE public.device_write_id_seq OWNED BY public.device_write.id;

CREATE TABLE public.lot (
    id bigint NOT NULL,
    part character varying(200) NOT NULL,
    name character varying(200) NOT NULL
);

ALTER TABLE public.lot OWNER TO postgres;

CREATE SEQUENCE public.lot_id_seq
    START WITH 1
    INCREMENT BY 1
    NO MINVALUE
    NO MAXVALUE
    CACHE 1;

ALTER TABLE public.lot_id_seq OWNER TO postgres;

ALTER SEQUENCE public.lot_id_seq OWNED BY public.lot.id;

CREATE TABLE public.measurement (
    id bigint NOT NULL,
    step_id bigint NOT NULL,
    name character varying(200) NOT NULL,
    value double precision,
    unit character varying(16) NOT NULL,
    low double precision,
    high double precision,
    text text,
    expected text,
    CONSTRAINT number_or_text CHECK (((value IS NULL) <> (text IS NULL)))
);

ALTER TABLE public.measurement OWNER TO postgres;

CREATE SEQUENCE public.measurement_id_seq
    START WITH 1
    INCREMENT BY 1
    NO MINVALUE
    NO MAXVALUE
    CACHE 1;

ALTER TABLE public.measurement_id_seq OWNER TO postgres;

ALTER SEQUENCE public.measurement_id_seq OWNED BY public.measurement.id;

CREATE TABLE public.operator (
    id bigint NOT NULL,
    name character varying(200) NOT NULL
);

ALTER TABLE public.operator OWNER TO postgres;

CREATE SEQUENCE public.operator_id_seq
    START WITH 1
    INCREMENT BY 1
    NO MINVALUE
    NO MAXVALUE
    CACHE 1;

ALTER TABLE public.operator_id_seq OWNER TO postgres;

ALTER SEQUENCE public.operator_id_seq OWNED BY public.operator.id;

CREATE TABLE public.plant_claim (
    token text NOT NULL,
    station uuid NOT NULL,
    part text NOT NULL,
    serial text NOT NULL,
    socket text NOT NULL,
    claimed_at timestamp with time zone NOT NULL,
    expires_at timestamp with time zone NOT NULL
);

ALTER TABLE public.plant_claim OWNER TO postgres;

CREATE TABLE public.plant_duplicate (
    run_id bigint NOT NULL,
    first_run_id bigint NOT NULL
);

ALTER TABLE public.plant_duplicate OWNER TO postgres;

CREATE TABLE public.plant_pass (
    unit_id bigint NOT NULL,
    is_virtual boolean NOT NULL,
    run_id bigint NOT NULL,
    station uuid NOT NULL
);

ALTER TABLE public.plant_pass OWNER TO postgres;

CREATE TABLE public.plant_station (
    role text NOT NULL,
    name text NOT NULL,
    records_id text,
    station uuid,
    entered_at timestamp with time zone,
    reported_at timestamp with time zone,
    version text DEFAULT ''::text NOT NULL,
    unsent bigint,
    oldest_unsent_at text,
    clock_offset_s double precision,
    disk_free_bytes bigint,
    refusal text DEFAULT ''::text NOT NULL
);

ALTER TABLE public.plant_station OWNER TO postgres;

CREATE TABLE public.plant_version (
    version_num character varying(32) NOT NULL
);

ALTER TABLE public.plant_version OWNER TO postgres;

CREATE TABLE public.recipe (
    id bigint NOT NULL,
    name character varying(200) NOT NULL,
    revision character varying(64) NOT NULL,
    part character varying(200) NOT NULL,
    sha256 character varying(64) NOT NULL,
    content text NOT NULL,
    verification_required smallint NOT NULL,
    allow_completed_not_read_back boolean NOT NULL,
    CONSTRAINT level_is_known CHECK (((verification_required >= 0) AND (verification_required <= 2))),
    CONSTRAINT sha256_is_whole CHECK ((length((sha256)::text) = 64))
);

ALTER TABLE public.recipe OWNER TO postgres;

CREATE SEQUENCE public.recipe_id_seq
    START WITH 1
    INCREMENT BY 1
    NO MINVALUE
    NO MAXVALUE
    CACHE 1;

ALTER TABLE public.recipe_id_seq OWNER TO postgres;

ALTER SEQUENCE public.recipe_id_seq OWNED BY public.recipe.id;

CREATE TABLE public.run (
    id bigint NOT NULL,
    unit_id bigint NOT NULL,
    socket_id bigint NOT NULL,
    recipe_id bigint NOT NULL,
    lot_id bigint,
    operator_id bigint NOT NULL,
    kind character varying(16) NOT NULL,
    is_virtual boolean NOT NULL,
    reason text NOT NULL,
    state character varying(16) NOT NULL,
    code character varying(64) NOT NULL,
    text text NOT NULL,
    begun_at character varying(27) NOT NULL,
    begun_monotonic_s double precision NOT NULL,
    ended_at character varying(27),
    ended_monotonic_s double precision,
    verification_required smallint NOT NULL,
    allow_completed_not_read_back boolean NOT NULL,
    verification_reached smallint,
    log_sha256 character varying(64),
    CONSTRAINT finished_has_a_code CHECK ((((state)::text = 'RUNNING'::text) OR ((code)::text <> ''::text))),
    CONSTRAINT finished_has_a_duration CHECK ((((state)::text = ANY ((ARRAY['RUNNING'::character varying, 'INTERRUPTED'::character varying])::text[])) OR (ended_monotonic_s IS NOT NULL))),
    CONSTRAINT finished_has_an_end CHECK ((((state)::text = 'RUNNING'::text) = (ended_at IS NULL))),
    CONSTRAINT kind_is_known CHECK (((kind)::text = ANY ((ARRAY['production'::character varying, 'recheck'::character varying, 'verify-only'::character varying, 'reflash'::character varying, 'golden'::character varying])::text[]))),
    CONSTRAINT pass_has_an_end_and_a_log CHECK ((((state)::text <> 'PASS'::text) OR ((ended_at IS NOT NULL) AND (log_sha256 IS NOT NULL) AND (length((log_sha256)::text) = 64)))),
    CONSTRAINT pass_is_read_back CHECK ((((state)::text <> 'PASS'::text) OR allow_completed_not_read_back OR (verification_reached > 0))),
    CONSTRAINT pass_is_verified CHECK ((((state)::text <> 'PASS'::text) OR ((verification_reached IS NOT NULL) AND (verification_reached >= verification_required)))),
    CONSTRAINT reached_is_known CHECK (((verification_reached >= 0) AND (verification_reached <= 2))),
    CONSTRAINT reflash_has_a_reason CHECK ((((kind)::text <> 'reflash'::text) OR (reason <> ''::text))),
    CONSTRAINT required_is_known CHECK (((verification_required >= 0) AND (verification_required <= 2))),
    CONSTRAINT state_is_known CHECK (((state)::text = ANY ((ARRAY['RUNNING'::character varying, 'PASS'::character varying, 'FAIL'::character varying, 'ERROR'::character varying, 'ABORTED'::character varying, 'INTERRUPTED'::character varying])::text[]))),
    CONSTRAINT time_goes_forward CHECK (((ended_monotonic_s IS NULL) OR (ended_monotonic_s >= begun_monotonic_s)))
);

ALTER TABLE public.run OWNER TO postgres;

CREATE SEQUENCE public.run_id_seq
    START WITH 1
    INCREMENT BY 1
    NO MINVALUE
    NO MAXVALUE
    CACHE 1;

ALTER TABLE public.run_id_seq OWNER TO postgres;

ALTER SEQUENCE public.run_id_seq OWNED BY public.run.id;

CREATE TABLE public.run_target (
    id bigint NOT NULL,
    run_id bigint NOT NULL,
    artifact_id bigint NOT NULL,
    "position" smallint NOT NULL,
    target character varying(16) NOT NULL,
    required smallint NOT NULL,
    reached smallint,
    CONSTRAINT levels_are_known CHECK ((((required >= 0) AND (required <= 2)) AND ((reached >= 0) AND (reached <= 2))))
);

ALTER TABLE public.run_target OWNER TO postgres;

CREATE SEQUENCE public.run_target_id_seq
    START WITH 1
    INCREMENT BY 1
    NO MINVALUE
    NO MAXVALUE
    CACHE 1;

ALTER TABLE public.run_target_id_seq OWNER TO postgres;

ALTER SEQUENCE public.run_target_id_seq OWNED BY public.run_target.id;

CREATE TABLE public.schema_info (
    version integer NOT NULL,
    created_at character varying(27) NOT NULL,
    records_id character varying(32) NOT NULL
);

ALTER TABLE public.schema_info OWNER TO postgres;

CREATE TABLE public.shared_part (
    station uuid NOT NULL,
    sha256 text NOT NULL,
    content text NOT NULL,
    CONSTRAINT part_is_whole CHECK ((sha256 = encode(sha256(convert_to(content, 'UTF8'::name)), 'hex'::text)))
);

ALTER TABLE public.shared_part OWNER TO postgres;

CREATE TABLE public.socket (
    id bigint NOT NULL,
    station_id bigint NOT NULL,
    name character varying(200) NOT NULL
);

ALTER TABLE public.socket OWNER TO postgres;

CREATE SEQUENCE public.socket_id_seq
    START WITH 1
    INCREMENT BY 1
    NO MINVALUE
    NO MAXVALUE
    CACHE 1;

ALTER TABLE public.socket_id_seq OWNER TO postgres;

ALTER SEQUENCE public.socket_id_seq OWNED BY public.socket.id;

CREATE TABLE public.station (
    id bigint NOT NULL,
    name character varying(200) NOT NULL
);

ALTER TABLE public.station OWNER TO postgres;

CREATE SEQUENCE public.station_id_seq
    START WITH 1
    INCREMENT BY 1
    NO MINVALUE
    NO MAXVALUE
    CACHE 1;

ALTER TABLE public.station_id_seq OWNER TO postgres;

ALTER SEQUENCE public.station_id_seq OWNED BY public.station.id;

CREATE TABLE public.step (
    id bigint NOT NULL,
    run_id bigint NOT NULL,
    "position" integer NOT NULL,
    name character varying(32) NOT NULL,
    try_number integer NOT NULL,
    state character varying(16) NOT NULL,
    code character varying(64) NOT NULL,
    text text NOT NULL,
    begun_at character varying(27) NOT NULL,
    begun_monotonic_s double precision NOT NULL,
    duration_s double precision NOT NULL,
    CONSTRAINT state_is_known CHECK (((state)::text = ANY ((ARRAY['PASS'::character varying, 'FAIL'::character varying, 'ERROR'::character varying, 'SKIPPED'::character varying])::text[]))),
    CONSTRAINT step_is_possible CHECK (((duration_s >= (0)::double precision) AND (try_number >= 1)))
);

ALTER TABLE public.step OWNER TO postgres;

CREATE SEQUENCE public.step_id_seq
    START WITH 1
    INCREMENT BY 1
    NO MINVALUE
    NO MAXVALUE
    CACHE 1;

ALTER TABLE public.step_id_seq OWNER TO postgres;

ALTER SEQUENCE public.step_id_seq OWNED BY public.step.id;

CREATE TABLE public.trace (
    sha256 text NOT NULL,
    data bytea NOT NULL,
    CONSTRAINT trace_is_whole CHECK ((sha256 = encode(sha256(data), 'hex'::text)))
);

ALTER TABLE public.trace OWNER TO postgres;

CREATE TABLE public.unit (
    id bigint NOT NULL,
    part character varying(200) NOT NULL,
    serial character varying(200) NOT NULL,
    CONSTRAINT unit_has_a_name CHECK ((((serial)::text <> ''::text) AND ((part)::text <> ''::text)))
);

ALTER TABLE public.unit OWNER TO postgres;

CREATE SEQUENCE public.unit_id_seq
    START WITH 1
    INCREMENT BY 1
    NO MINVALUE
    NO MAXVALUE
    CACHE 1;

ALTER TABLE public.unit_id_seq OWNER TO postgres;

ALTER SEQUENCE public.unit_id_seq OWNED BY public.unit.id;

ALTER TABLE ONLY public.artifact ALTER COLUMN id SET DEFAULT nextval('public.artifact_id_seq'::regclass);

ALTER TABLE ONLY public.attachment ALTER COLUMN id SET DEFAULT nextval('public.attachment_id_seq'::regclass);

ALTER TABLE ONLY public.device_write ALTER COLUMN id SET DEFAULT nextval('public.device_write_id_seq'::regclass);

ALTER TABLE ONLY public.lot ALTER COLUMN id SET DEFAULT nextval('public.lot_id_seq'::regclass);

ALTER TABLE ONLY public.measurement ALTER COLUMN id SET DEFAULT nextval('public.measurement_id_seq'::regclass);

ALTER TABLE ONLY public.operator ALTER COLUMN id SET DEFAULT nextval('public.operator_id_seq'::regclass);

ALTER TABLE ONLY public.recipe ALTER COLUMN id SET DEFAULT nextval('public.recipe_id_seq'::regclass);

ALTER TABLE ONLY public.run ALTER COLUMN id SET DEFAULT nextval('public.run_id_seq'::regclass);

ALTER TABLE ONLY public.run_target ALTER COLUMN id SET DEFAULT nextval('public.run_target_id_seq'::regclass);

ALTER TABLE ONLY public.socket ALTER COLUMN id SET DEFAULT nextval('public.socket_id_seq'::regclass);

ALTER TABLE ONLY public.station ALTER COLUMN id SET DEFAULT nextval('public.station_id_seq'::regclass);

ALTER TABLE ONLY public.step ALTER COLUMN id SET DEFAULT nextval('public.step_id_seq'::regclass);

ALTER TABLE ONLY public.unit ALTER COLUMN id SET DEFAULT nextval('public.unit_id_seq'::regclass);

INSERT INTO public.alembic_version VALUES ('3');

INSERT INTO public.plant_version VALUES ('2');

INSERT INTO public.schema_info VALUES (3, '2026-11-28T08:35:06.981955Z', 'ede05bc6e1904ea789cb6343daab96d9');

SELECT pg_catalog.setval('public.artifact_id_seq', 1, false);

SELECT pg_catalog.setval('public.attachment_id_seq', 1, false);

SELECT pg_catalog.setval('public.chain_row_id_seq', 1, false);

SELECT pg_catalog.setval('public.device_write_id_seq', 1, false);

SELECT pg_catalog.setval('public.lot_id_seq', 1, false);

SELECT pg_catalog.setval('public.measurement_id_seq', 1, false);

SELECT pg_catalog.setval('public.operator_id_seq', 1, false);

SELECT pg_catalog.setval('public.recipe_id_seq', 1, false);

SELECT pg_catalog.setval('public.run_id_seq', 1, false);

SELECT pg_catalog.setval('public.run_target_id_seq', 1, false);

SELECT pg_catalog.setval('public.socket_id_seq', 1, false);

SELECT pg_catalog.setval('public.station_id_seq', 1, false);

SELECT pg_catalog.setval('public.step_id_seq', 1, false);

SELECT pg_catalog.setval('public.unit_id_seq', 1, false);

ALTER TABLE ONLY public.alembic_version
    ADD CONSTRAINT alembic_version_pkc PRIMARY KEY (version_num);

ALTER TABLE ONLY public.artifact
    ADD CONSTRAINT artifact_pkey PRIMARY KEY (id);

ALTER TABLE ONLY public.attachment
    ADD CONSTRAINT attachment_pkey PRIMARY KEY (id);

ALTER TABLE ONLY public.attachment
    ADD CONSTRAINT attachment_run_id_kind_name_key UNIQUE (run_id, kind, name);

ALTER TABLE ONLY public.chain_row
    ADD CONSTRAINT chain_row_hash_key UNIQUE (hash);

ALTER TABLE ONLY public.chain_row
    ADD CONSTRAINT chain_row_id_key UNIQUE (id);

ALTER TABLE ONLY public.chain_row
    ADD CONSTRAINT chain_row_pkey PRIMARY KEY (station, number);

ALTER TABLE ONLY public.device_write
    ADD CONSTRAINT device_write_pkey PRIMARY KEY (id);

ALTER TABLE ONLY public.lot
    ADD CONSTRAINT lot_part_name_key UNIQUE (part, name);

ALTER TABLE ONLY public.lot
    ADD CONSTRAINT lot_pkey PRIMARY KEY (id);

ALTER TABLE ONLY public.measurement
    ADD CONSTRAINT measurement_pkey PRIMARY KEY (id);

ALTER TABLE ONLY public.operator
    ADD CONSTRAINT operator_name_key UNIQUE (name);

ALTER TABLE ONLY public.operator
    ADD CONSTRAINT operator_pkey PRIMARY KEY (id);

ALTER TABLE ONLY public.plant_claim
    ADD CONSTRAINT plant_claim_pkey PRIMARY KEY (token);

ALTER TABLE ONLY public.plant_duplicate
    ADD CONSTRAINT plant_duplicate_pkey PRIMARY KEY (run_id);

ALTER TABLE ONLY public.plant_pass
    ADD CONSTRAINT plant_pass_pkey PRIMARY KEY (unit_id, is_virtual);

ALTER TABLE ONLY public.plant_station
    ADD CONSTRAINT plant_station_name_key UNIQUE (name);

ALTER TABLE ONLY public.plant_station
    ADD CONSTRAINT plant_station_pkey PRIMARY KEY (role);

ALTER TABLE ONLY public.plant_station
    ADD CONSTRAINT plant_station_station_key UNIQUE (station);

ALTER TABLE ONLY public.plant_version
    ADD CONSTRAINT plant_version_pkc PRIMARY KEY (version_num);

ALTER TABLE ONLY public.recipe
    ADD CONSTRAINT recipe_pkey PRIMARY KEY (id);

ALTER TABLE ONLY public.run
    ADD CONSTRAINT run_pkey PRIMARY KEY (id);

ALTER TABLE ONLY public.run_target
    ADD CONSTRAINT run_target_pkey PRIMARY KEY (id);

ALTER TABLE ONLY public.run_target
    ADD CONSTRAINT run_target_run_id_target_key UNIQUE (run_id, target);

ALTER TABLE ONLY public.schema_info
    ADD CONSTRAINT schema_info_pkey PRIMARY KEY (version);

ALTER TABLE ONLY public.shared_part
    ADD CONSTRAINT shared_part_pkey PRIMARY KEY (station, sha256);

ALTER TABLE ONLY public.socket
    ADD CONSTRAINT socket_pkey PRIMARY KEY (id);

ALTER TABLE ONLY public.socket
    ADD CONSTRAINT socket_station_id_name_key UNIQUE (station_id, name);

ALTER TABLE ONLY public.station
    ADD CONSTRAINT station_name_key UNIQUE (name);

ALTER TABLE ONLY public.station
    ADD CONSTRAINT station_pkey PRIMARY KEY (id);

ALTER TABLE ONLY public.step
    ADD CONSTRAINT step_pkey PRIMARY KEY (id);

ALTER TABLE ONLY public.step
    ADD CONSTRAINT step_run_id_position_key UNIQUE (run_id, "position");

ALTER TABLE ONLY public.trace
    ADD CONSTRAINT trace_pkey PRIMARY KEY (sha256);

ALTER TABLE ONLY public.unit
    ADD CONSTRAINT unit_part_serial_key UNIQUE (part, serial);

ALTER TABLE ONLY public.unit
    ADD CONSTRAINT unit_pkey PRIMARY KEY (id);

CREATE UNIQUE INDEX artifact_as_stated ON public.artifact USING btree (sha256, target, name, version, size_bytes);

CREATE INDEX chain_row_by_event ON public.chain_row USING btree (event, id);

CREATE INDEX chain_row_by_time ON public.chain_row USING btree (station_id, at);

CREATE INDEX chain_row_of_number ON public.chain_row USING btree (station, run_number);

CREATE INDEX claim_of_station ON public.plant_claim USING btree (station, expires_at);

CREATE INDEX claim_of_unit ON public.plant_claim USING btree (part, serial);

CREATE INDEX ix_attachment_run_id ON public.attachment USING btree (run_id);

CREATE INDEX ix_chain_row_run_id ON public.chain_row USING btree (run_id);

CREATE INDEX ix_device_write_run_id ON public.device_write USING btree (run_id);

CREATE INDEX ix_measurement_step_id ON public.measurement USING btree (step_id);

CREATE UNIQUE INDEX one_running_run_per_socket ON public.run USING btree (socket_id) WHERE ((state)::text = 'RUNNING'::text);

CREATE UNIQUE INDEX one_running_run_per_unit ON public.run USING btree (unit_id) WHERE ((state)::text = 'RUNNING'::text);

CREATE UNIQUE INDEX recipe_as_stated ON public.recipe USING btree (sha256, name, revision, part, verification_required, allow_completed_not_read_back, md5(content));

CREATE INDEX run_by_begin ON public.run USING btree (begun_at);

CREATE INDEX run_by_code ON public.run USING btree (code, id);

CREATE INDEX run_by_kind ON public.run USING btree (kind, socket_id);

CREATE INDEX run_by_nature ON public.run USING btree (is_virtual);

CREATE INDEX run_by_state ON public.run USING btree (state, id);

CREATE INDEX run_of_lot ON public.run USING btree (lot_id, id);

CREATE INDEX run_of_recipe ON public.run USING btree (recipe_id, id);

CREATE INDEX run_of_socket ON public.run USING btree (socket_id, id);

CREATE INDEX run_of_unit ON public.run USING btree (unit_id, id);

CREATE INDEX target_with_image ON public.run_target USING btree (artifact_id, id);

CREATE INDEX unit_by_serial ON public.unit USING btree (serial);

CREATE TRIGGER plant_bring BEFORE INSERT ON public.chain_row FOR EACH ROW EXECUTE FUNCTION public.plant_bring();

CREATE TRIGGER plant_end_claims AFTER INSERT ON public.chain_row FOR EACH ROW WHEN ((new.content IS NOT NULL)) EXECUTE FUNCTION public.plant_end_claims();

ALTER TABLE ONLY public.attachment
    ADD CONSTRAINT attachment_run_id_fkey FOREIGN KEY (run_id) REFERENCES public.run(id) ON DELETE RESTRICT;

ALTER TABLE ONLY public.device_write
    ADD CONSTRAINT device_write_run_id_fkey FOREIGN KEY (run_id) REFERENCES public.run(id) ON DELETE RESTRICT;

ALTER TABLE ONLY public.measurement
    ADD CONSTRAINT measurement_step_id_fkey FOREIGN KEY (step_id) REFERENCES public.step(id) ON DELETE RESTRICT;

ALTER TABLE ONLY public.run
    ADD CONSTRAINT run_lot_id_fkey FOREIGN KEY (lot_id) REFERENCES public.lot(id) ON DELETE RESTRICT;

ALTER TABLE ONLY public.run
    ADD CONSTRAINT run_operator_id_fkey FOREIGN KEY (operator_id) REFERENCES public.operator(id) ON DELETE RESTRICT;

ALTER TABLE ONLY public.run
    ADD CONSTRAINT run_recipe_id_fkey FOREIGN KEY (recipe_id) REFERENCES public.recipe(id) ON DELETE RESTRICT;

ALTER TABLE ONLY public.run
    ADD CONSTRAINT run_socket_id_fkey FOREIGN KEY (socket_id) REFERENCES public.socket(id) ON DELETE RESTRICT;

ALTER TABLE ONLY public.run_target
    ADD CONSTRAINT run_target_artifact_id_fkey FOREIGN KEY (artifact_id) REFERENCES public.artifact(id) ON DELETE RESTRICT;

ALTER TABLE ONLY public.run_target
    ADD CONSTRAINT run_target_run_id_fkey FOREIGN KEY (run_id) REFERENCES public.run(id) ON DELETE RESTRICT;

ALTER TABLE ONLY public.run
    ADD CONSTRAINT run_unit_id_fkey FOREIGN KEY (unit_id) REFERENCES public.unit(id) ON DELETE RESTRICT;

ALTER TABLE ONLY public.socket
    ADD CONSTRAINT socket_station_id_fkey FOREIGN KEY (station_id) REFERENCES public.station(id) ON DELETE RESTRICT;

ALTER TABLE ONLY public.step
    ADD CONSTRAINT step_run_id_fkey FOREIGN KEY (run_id) REFERENCES public.run(id) ON DELETE RESTRICT;

ALTER TABLE public.chain_row ENABLE ROW LEVEL SECURITY;

CREATE POLICY chain_row_is_read ON public.chain_row FOR SELECT TO flasher_readers USING (true);

CREATE POLICY chain_row_of_own_station ON public.chain_row FOR INSERT WITH CHECK ((station = ( SELECT public.plant_my_station() AS plant_my_station)));

CREATE POLICY part_of_own_station ON public.shared_part FOR INSERT WITH CHECK ((station = ( SELECT public.plant_my_station() AS plant_my_station)));

ALTER TABLE public.plant_station ENABLE ROW LEVEL SECURITY;

CREATE POLICY plant_station_is_read ON public.plant_station FOR SELECT TO flasher_readers USING (true);

ALTER TABLE public.shared_part ENABLE ROW LEVEL SECURITY;

CREATE POLICY shared_part_is_read ON public.shared_part FOR SELECT TO flasher_readers USING (true);

ALTER TABLE public.trace ENABLE ROW LEVEL SECURITY;

CREATE POLICY trace_is_read ON public.trace FOR SELECT TO flasher_readers USING (true);

CREATE POLICY trace_of_a_station ON public.trace FOR INSERT WITH CHECK ((( SELECT public.plant_my_station() AS plant_my_station) IS NOT NULL));

REVOKE USAGE ON SCHEMA public FROM PUBLIC;
GRANT USAGE ON SCHEMA public TO flasher_stations;
GRANT USAGE ON SCHEMA public TO flasher_readers;

REVOKE ALL ON FUNCTION public.plant_add_run(own jsonb, shared jsonb) FROM PUBLIC;

REVOKE ALL ON FUNCTION public.plant_bring() FROM PUBLIC;

REVOKE ALL ON FUNCTION public.plant_claim(of_token text, of_part text, of_serial text, of_virtual boolean, at_socket text, lease_s double precision, OUT state text, OUT station text, OUT socket text, OUT at timestamp with time zone, OUT run bigint) FROM PUBLIC;
GRANT ALL ON FUNCTION public.plant_claim(of_token text, of_part text, of_serial text, of_virtual boolean, at_socket text, lease_s double precision, OUT state text, OUT station text, OUT socket text, OUT at timestamp with time zone, OUT run bigint) TO flasher_stations;

REVOKE ALL ON FUNCTION public.plant_claims() FROM PUBLIC;
GRANT ALL ON FUNCTION public.plant_claims() TO flasher_stations;

REVOKE ALL ON FUNCTION public.plant_end_claims() FROM PUBLIC;

REVOKE ALL ON FUNCTION public.plant_enter(of_records text, called text, OUT station uuid, OUT head_number bigint, OUT head_hash text, OUT now timestamp with time zone) FROM PUBLIC;
GRANT ALL ON FUNCTION public.plant_enter(of_records text, called text, OUT station uuid, OUT head_number bigint, OUT head_hash text, OUT now timestamp with time zone) TO flasher_stations;

REVOKE ALL ON FUNCTION public.plant_my_station() FROM PUBLIC;
GRANT ALL ON FUNCTION public.plant_my_station() TO flasher_stations;

REVOKE ALL ON FUNCTION public.plant_named(in_table text, names text[], key jsonb) FROM PUBLIC;

REVOKE ALL ON FUNCTION public.plant_release(tokens text[]) FROM PUBLIC;
GRANT ALL ON FUNCTION public.plant_release(tokens text[]) TO flasher_stations;

REVOKE ALL ON FUNCTION public.plant_renew(tokens text[], lease_s double precision) FROM PUBLIC;
GRANT ALL ON FUNCTION public.plant_renew(tokens text[], lease_s double precision) TO flasher_stations;

REVOKE ALL ON FUNCTION public.plant_report(reporting text, is_unsent bigint, oldest text, offset_s double precision, free_bytes bigint, refused text) FROM PUBLIC;
GRANT ALL ON FUNCTION public.plant_report(reporting text, is_unsent bigint, oldest text, offset_s double precision, free_bytes bigint, refused text) TO flasher_stations;

GRANT SELECT ON TABLE public.alembic_version TO flasher_readers;

GRANT SELECT ON TABLE public.artifact TO flasher_readers;

GRANT SELECT ON TABLE public.attachment TO flasher_readers;

GRANT SELECT ON TABLE public.chain_row TO flasher_readers;

GRANT INSERT(station) ON TABLE public.chain_row TO flasher_stations;

GRANT INSERT(number) ON TABLE public.chain_row TO flasher_stations;

GRANT INSERT(at) ON TABLE public.chain_row TO flasher_stations;

GRANT INSERT(event) ON TABLE public.chain_row TO flasher_stations;

GRANT INSERT(run_number) ON TABLE public.chain_row TO flasher_stations;

GRANT INSERT(data) ON TABLE public.chain_row TO flasher_stations;

GRANT INSERT(previous_hash) ON TABLE public.chain_row TO flasher_stations;

GRANT INSERT(hash) ON TABLE public.chain_row TO flasher_stations;

GRANT INSERT(signature) ON TABLE public.chain_row TO flasher_stations;

GRANT INSERT(content) ON TABLE public.chain_row TO flasher_stations;

GRANT SELECT ON TABLE public.audit TO flasher_readers;

GRANT SELECT ON TABLE public.device_write TO flasher_readers;

GRANT SELECT ON TABLE public.lot TO flasher_readers;

GRANT SELECT ON TABLE public.measurement TO flasher_readers;

GRANT SELECT ON TABLE public.operator TO flasher_readers;

GRANT SELECT ON TABLE public.plant_claim TO flasher_readers;

GRANT SELECT ON TABLE public.plant_duplicate TO flasher_readers;

GRANT SELECT ON TABLE public.plant_pass TO flasher_readers;

GRANT SELECT ON TABLE public.plant_station TO flasher_readers;

GRANT SELECT ON TABLE public.plant_version TO flasher_readers;

GRANT SELECT ON TABLE public.recipe TO flasher_readers;

GRANT SELECT ON TABLE public.run TO flasher_readers;

GRANT SELECT ON TABLE public.run_target TO flasher_readers;

GRANT SELECT ON TABLE public.schema_info TO flasher_readers;

GRANT INSERT ON TABLE public.shared_part TO flasher_stations;
GRANT SELECT ON TABLE public.shared_part TO flasher_readers;

GRANT SELECT ON TABLE public.socket TO flasher_readers;

GRANT SELECT ON TABLE public.station TO flasher_readers;

GRANT SELECT ON TABLE public.step TO flasher_readers;

GRANT INSERT ON TABLE public.trace TO flasher_stations;
GRANT SELECT ON TABLE public.trace TO flasher_readers;

GRANT SELECT ON TABLE public.unit TO flasher_readers;
