-- Records of version 1, as the flasher of that time made them: a good unit, a bad one, one that runs.
BEGIN TRANSACTION;
CREATE TABLE artifact (
	id INTEGER NOT NULL, 
	target VARCHAR(16) NOT NULL, 
	name VARCHAR(200) NOT NULL, 
	version VARCHAR(64) NOT NULL, 
	sha256 VARCHAR(64) NOT NULL, 
	size_bytes BIGINT NOT NULL, 
	PRIMARY KEY (id), 
	UNIQUE (target, sha256, name), 
	CONSTRAINT sha256_is_whole CHECK (length(sha256) = 64)
);
INSERT INTO "artifact" VALUES(1,'bms','bms.bin','V1r0r4_20220512','8e18639a88b0406a35f939ccd1b44dbf42ab869c4f4bbec93fe775d56fe71ba7',219);
CREATE TABLE attachment (
	id INTEGER NOT NULL, 
	run_id INTEGER NOT NULL, 
	kind VARCHAR(32) NOT NULL, 
	name VARCHAR(200) NOT NULL, 
	sha256 VARCHAR(64) NOT NULL, 
	size_bytes BIGINT NOT NULL, 
	PRIMARY KEY (id), 
	UNIQUE (run_id, kind, name), 
	CONSTRAINT sha256_is_whole CHECK (length(sha256) = 64), 
	FOREIGN KEY(run_id) REFERENCES run (id) ON DELETE RESTRICT
);
INSERT INTO "attachment" VALUES(1,1,'trace','trace.asc','5bde7e08824cf1ff95a6efd4630ed0363025b9f2d0d7f13dbf9909c403a38aaf',16);
INSERT INTO "attachment" VALUES(2,2,'trace','trace.asc','5bde7e08824cf1ff95a6efd4630ed0363025b9f2d0d7f13dbf9909c403a38aaf',16);
CREATE TABLE audit (
	id INTEGER NOT NULL, 
	at VARCHAR(27) NOT NULL, 
	event VARCHAR(32) NOT NULL, 
	run_id INTEGER, 
	data TEXT NOT NULL, 
	previous_hash VARCHAR(64) NOT NULL, 
	hash VARCHAR(64) NOT NULL, 
	PRIMARY KEY (id), 
	UNIQUE (previous_hash), 
	UNIQUE (hash), 
	FOREIGN KEY(run_id) REFERENCES run (id) ON DELETE RESTRICT
);
INSERT INTO "audit" VALUES(1,'2026-05-17T09:00:00.000000Z','created',NULL,'{"version":1}','0000000000000000000000000000000000000000000000000000000000000000','1987935319b42ff2368de1e7d342236cd1c3ef491f729b54ac43c6cda4c0b325');
INSERT INTO "audit" VALUES(2,'2026-05-17T09:00:00.000000Z','recipe',NULL,'{"name":"Battery 36 V","revision":"4","sha256":"74feb717955a6d66a0316c79815e7228ca5870fd3ed76f90fa06ccfb743cf557"}','1987935319b42ff2368de1e7d342236cd1c3ef491f729b54ac43c6cda4c0b325','8b4115387a642a78c2a9e171912fd0eb2ef9ec752fab85804a8bd6afd0bd7dfd');
INSERT INTO "audit" VALUES(3,'2026-05-17T09:00:08.000000Z','finished',1,'{"digest":"2149868656c2081f21209d64db2dfcf5ef0f6afd12adb3fb5d1832b2ecec15a3","state":"PASS"}','8b4115387a642a78c2a9e171912fd0eb2ef9ec752fab85804a8bd6afd0bd7dfd','57d20dd46fa93c30df791fedc9028a6385455732079e386807f557f18e72efc0');
INSERT INTO "audit" VALUES(4,'2026-05-17T09:00:18.000000Z','finished',2,'{"digest":"3568627dcc580829ddce53ea867647b98c70cb76f0fa15d60c887dab0483714e","state":"FAIL"}','57d20dd46fa93c30df791fedc9028a6385455732079e386807f557f18e72efc0','08d683c66196f245d8871d805150efc0cfe3b274bbeb7f5dffa0054f923dba23');
CREATE TABLE device_write (
	id INTEGER NOT NULL, 
	run_id INTEGER NOT NULL, 
	target VARCHAR(16) NOT NULL, 
	what VARCHAR(64) NOT NULL, 
	value TEXT NOT NULL, 
	intended_at VARCHAR(27) NOT NULL, 
	intended_monotonic_s FLOAT NOT NULL, 
	verified_at VARCHAR(27), 
	read_back TEXT, 
	PRIMARY KEY (id), 
	CONSTRAINT read_back_is_verified CHECK (read_back IS NULL OR verified_at IS NOT NULL), 
	FOREIGN KEY(run_id) REFERENCES run (id) ON DELETE RESTRICT
);
INSERT INTO "device_write" VALUES(1,1,'bms','flash','V1r0r4_20220512','2026-05-17T09:00:00.000000Z',100.0,'2026-05-17T09:00:08.000000Z','V1r0r4_20220512');
INSERT INTO "device_write" VALUES(2,2,'bms','flash','V1r0r4_20220512','2026-05-17T09:00:10.000000Z',110.0,'2026-05-17T09:00:18.000000Z','V1r0r4_20220512');
INSERT INTO "device_write" VALUES(3,3,'bms','flash','V1r0r4_20220512','2026-05-17T09:00:20.000000Z',120.0,'2026-05-17T09:00:28.000000Z','V1r0r4_20220512');
CREATE TABLE lot (
	id INTEGER NOT NULL, 
	part VARCHAR(200) NOT NULL, 
	name VARCHAR(200) NOT NULL, 
	PRIMARY KEY (id), 
	UNIQUE (part, name)
);
INSERT INTO "lot" VALUES(1,'BAT-36','L1');
CREATE TABLE measurement (
	id INTEGER NOT NULL, 
	step_id INTEGER NOT NULL, 
	name VARCHAR(200) NOT NULL, 
	value FLOAT, 
	unit VARCHAR(16) NOT NULL, 
	low FLOAT, 
	high FLOAT, 
	text TEXT, 
	expected TEXT, 
	PRIMARY KEY (id), 
	CONSTRAINT number_or_text CHECK ((value IS NULL) <> (text IS NULL)), 
	FOREIGN KEY(step_id) REFERENCES step (id) ON DELETE RESTRICT
);
CREATE TABLE operator (
	id INTEGER NOT NULL, 
	name VARCHAR(200) NOT NULL, 
	PRIMARY KEY (id), 
	UNIQUE (name)
);
INSERT INTO "operator" VALUES(1,'jo');
CREATE TABLE recipe (
	id INTEGER NOT NULL, 
	name VARCHAR(200) NOT NULL, 
	revision VARCHAR(64) NOT NULL, 
	part VARCHAR(200) NOT NULL, 
	sha256 VARCHAR(64) NOT NULL, 
	content TEXT NOT NULL, 
	verification_required SMALLINT NOT NULL, 
	allow_completed_not_read_back BOOLEAN NOT NULL, 
	PRIMARY KEY (id), 
	UNIQUE (sha256), 
	CONSTRAINT sha256_is_whole CHECK (length(sha256) = 64), 
	CONSTRAINT level_is_known CHECK (verification_required BETWEEN 0 AND 2)
);
INSERT INTO "recipe" VALUES(1,'Battery 36 V','4','BAT-36','74feb717955a6d66a0316c79815e7228ca5870fd3ed76f90fa06ccfb743cf557','name = "Battery 36 V"
part = "BAT-36"
revision = "4"

[serial_number]
pattern = ''W(?P<year>[0-9]{2})(?P<week>[0-9]{2})(?P<number>[0-9]{3})''
example = "W2605002"

[[target]]
target = "bms"
image = "bms.bin"
sha256 = "8e18639a88b0406a35f939ccd1b44dbf42ab869c4f4bbec93fe775d56fe71ba7"
',1,1);
CREATE TABLE run (
	id INTEGER NOT NULL, 
	unit_id INTEGER NOT NULL, 
	socket_id INTEGER NOT NULL, 
	recipe_id INTEGER NOT NULL, 
	lot_id INTEGER, 
	operator_id INTEGER NOT NULL, 
	kind VARCHAR(16) NOT NULL, 
	is_virtual BOOLEAN NOT NULL, 
	reason TEXT NOT NULL, 
	state VARCHAR(16) NOT NULL, 
	code VARCHAR(64) NOT NULL, 
	text TEXT NOT NULL, 
	begun_at VARCHAR(27) NOT NULL, 
	begun_monotonic_s FLOAT NOT NULL, 
	ended_at VARCHAR(27), 
	ended_monotonic_s FLOAT, 
	verification_required SMALLINT NOT NULL, 
	allow_completed_not_read_back BOOLEAN NOT NULL, 
	verification_reached SMALLINT, 
	log_sha256 VARCHAR(64), 
	PRIMARY KEY (id), 
	CONSTRAINT state_is_known CHECK (state IN ('RUNNING', 'PASS', 'FAIL', 'ERROR', 'ABORTED', 'INTERRUPTED')), 
	CONSTRAINT kind_is_known CHECK (kind IN ('production', 'recheck', 'verify-only', 'reflash', 'golden')), 
	CONSTRAINT finished_has_an_end CHECK ((state = 'RUNNING') = (ended_at IS NULL)), 
	CONSTRAINT finished_has_a_duration CHECK (state IN ('RUNNING', 'INTERRUPTED') OR ended_monotonic_s IS NOT NULL), 
	CONSTRAINT time_goes_forward CHECK (ended_monotonic_s IS NULL OR ended_monotonic_s >= begun_monotonic_s), 
	CONSTRAINT pass_has_an_end_and_a_log CHECK (state <> 'PASS' OR (ended_at IS NOT NULL AND log_sha256 IS NOT NULL AND length(log_sha256) = 64)), 
	CONSTRAINT pass_is_verified CHECK (state <> 'PASS' OR (verification_reached IS NOT NULL AND verification_reached >= verification_required)), 
	CONSTRAINT pass_is_read_back CHECK (state <> 'PASS' OR allow_completed_not_read_back OR verification_reached > 0), 
	CONSTRAINT reached_is_known CHECK (verification_reached BETWEEN 0 AND 2), 
	CONSTRAINT required_is_known CHECK (verification_required BETWEEN 0 AND 2), 
	CONSTRAINT finished_has_a_code CHECK (state = 'RUNNING' OR code <> ''), 
	CONSTRAINT reflash_has_a_reason CHECK (kind <> 'reflash' OR reason <> ''), 
	FOREIGN KEY(unit_id) REFERENCES unit (id) ON DELETE RESTRICT, 
	FOREIGN KEY(socket_id) REFERENCES socket (id) ON DELETE RESTRICT, 
	FOREIGN KEY(recipe_id) REFERENCES recipe (id) ON DELETE RESTRICT, 
	FOREIGN KEY(lot_id) REFERENCES lot (id) ON DELETE RESTRICT, 
	FOREIGN KEY(operator_id) REFERENCES operator (id) ON DELETE RESTRICT
);
INSERT INTO "run" VALUES(1,1,1,1,1,1,'production',0,'','PASS','OK','','2026-05-17T09:00:00.000000Z',100.0,'2026-05-17T09:00:08.000000Z',108.0,1,1,1,'5bde7e08824cf1ff95a6efd4630ed0363025b9f2d0d7f13dbf9909c403a38aaf');
INSERT INTO "run" VALUES(2,2,1,1,NULL,1,'production',0,'','FAIL','NO_ANSWER','','2026-05-17T09:00:10.000000Z',110.0,'2026-05-17T09:00:18.000000Z',118.0,1,1,NULL,'5bde7e08824cf1ff95a6efd4630ed0363025b9f2d0d7f13dbf9909c403a38aaf');
INSERT INTO "run" VALUES(3,3,1,1,NULL,1,'production',0,'','RUNNING','','','2026-05-17T09:00:20.000000Z',120.0,NULL,NULL,1,1,NULL,NULL);
CREATE TABLE run_target (
	id INTEGER NOT NULL, 
	run_id INTEGER NOT NULL, 
	artifact_id INTEGER NOT NULL, 
	position SMALLINT NOT NULL, 
	target VARCHAR(16) NOT NULL, 
	required SMALLINT NOT NULL, 
	reached SMALLINT, 
	PRIMARY KEY (id), 
	UNIQUE (run_id, target), 
	CONSTRAINT levels_are_known CHECK (required BETWEEN 0 AND 2 AND reached BETWEEN 0 AND 2), 
	FOREIGN KEY(run_id) REFERENCES run (id) ON DELETE RESTRICT, 
	FOREIGN KEY(artifact_id) REFERENCES artifact (id) ON DELETE RESTRICT
);
INSERT INTO "run_target" VALUES(1,1,1,1,'bms',1,1);
INSERT INTO "run_target" VALUES(2,2,1,1,'bms',1,NULL);
INSERT INTO "run_target" VALUES(3,3,1,1,'bms',1,NULL);
CREATE TABLE schema_info (
	version INTEGER NOT NULL, 
	created_at VARCHAR(27) NOT NULL, 
	PRIMARY KEY (version)
);
INSERT INTO "schema_info" VALUES(1,'2026-05-17T09:00:00.000000Z');
CREATE TABLE socket (
	id INTEGER NOT NULL, 
	station_id INTEGER NOT NULL, 
	name VARCHAR(200) NOT NULL, 
	PRIMARY KEY (id), 
	UNIQUE (station_id, name), 
	FOREIGN KEY(station_id) REFERENCES station (id) ON DELETE RESTRICT
);
INSERT INTO "socket" VALUES(1,1,'A');
CREATE TABLE station (
	id INTEGER NOT NULL, 
	name VARCHAR(200) NOT NULL, 
	PRIMARY KEY (id), 
	UNIQUE (name)
);
INSERT INTO "station" VALUES(1,'line-2');
CREATE TABLE step (
	id INTEGER NOT NULL, 
	run_id INTEGER NOT NULL, 
	position INTEGER NOT NULL, 
	name VARCHAR(32) NOT NULL, 
	try_number INTEGER NOT NULL, 
	state VARCHAR(16) NOT NULL, 
	code VARCHAR(64) NOT NULL, 
	text TEXT NOT NULL, 
	begun_at VARCHAR(27) NOT NULL, 
	begun_monotonic_s FLOAT NOT NULL, 
	duration_s FLOAT NOT NULL, 
	PRIMARY KEY (id), 
	UNIQUE (run_id, position), 
	CONSTRAINT state_is_known CHECK (state IN ('PASS', 'FAIL', 'ERROR', 'SKIPPED')), 
	CONSTRAINT step_is_possible CHECK (duration_s >= 0 AND try_number >= 1), 
	FOREIGN KEY(run_id) REFERENCES run (id) ON DELETE RESTRICT
);
INSERT INTO "step" VALUES(1,1,1,'flash',1,'PASS','','','2026-05-17T09:00:00.000000Z',100.0,8.0);
INSERT INTO "step" VALUES(2,2,1,'flash',1,'PASS','','','2026-05-17T09:00:10.000000Z',110.0,8.0);
INSERT INTO "step" VALUES(3,3,1,'flash',1,'PASS','','','2026-05-17T09:00:20.000000Z',120.0,8.0);
CREATE TABLE unit (
	id INTEGER NOT NULL, 
	part VARCHAR(200) NOT NULL, 
	serial VARCHAR(200) NOT NULL, 
	PRIMARY KEY (id), 
	UNIQUE (part, serial), 
	CONSTRAINT unit_has_a_name CHECK (serial <> '' AND part <> '')
);
INSERT INTO "unit" VALUES(1,'BAT-36','W2605002');
INSERT INTO "unit" VALUES(2,'BAT-36','W2605003');
INSERT INTO "unit" VALUES(3,'BAT-36','W2605004');
CREATE INDEX unit_by_serial ON unit (serial);
CREATE UNIQUE INDEX one_running_run_per_unit ON run (unit_id) WHERE state = 'RUNNING';
CREATE INDEX run_by_begin ON run (begun_at);
CREATE INDEX run_of_recipe ON run (recipe_id, begun_at);
CREATE INDEX ix_run_lot_id ON run (lot_id);
CREATE INDEX run_of_unit ON run (unit_id, id);
CREATE UNIQUE INDEX one_running_run_per_socket ON run (socket_id) WHERE state = 'RUNNING';
CREATE INDEX ix_device_write_run_id ON device_write (run_id);
CREATE INDEX ix_attachment_run_id ON attachment (run_id);
CREATE INDEX ix_audit_run_id ON audit (run_id);
CREATE INDEX ix_measurement_step_id ON measurement (step_id);
CREATE TRIGGER run_update BEFORE UPDATE ON run WHEN OLD.state <> 'RUNNING' BEGIN SELECT RAISE(ABORT, 'a finished run is final'); END;
CREATE TRIGGER run_delete BEFORE DELETE ON run WHEN 1 = 1 BEGIN SELECT RAISE(ABORT, 'records are not deleted'); END;
CREATE TRIGGER audit_update BEFORE UPDATE ON audit WHEN 1 = 1 BEGIN SELECT RAISE(ABORT, 'the audit trail is append-only'); END;
CREATE TRIGGER audit_chain BEFORE INSERT ON audit WHEN EXISTS (SELECT 1 FROM audit) AND NEW.previous_hash <> (SELECT hash FROM audit ORDER BY id DESC LIMIT 1) BEGIN SELECT RAISE(ABORT, 'an audit row names the hash of the row before it'); END;
COMMIT;
