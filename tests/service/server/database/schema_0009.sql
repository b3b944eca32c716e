-- The database of relit 0.1.0 (revision 0009), with something in the tables that matter. It never changes.
-- <BYTEWISE> is COLLATE "C" on PostgreSQL, and nothing on SQLite; <NUMBER> and
-- <LARGE NUMBER> are numbers that the database counts.
CREATE TABLE relit_about (version INTEGER NOT NULL, PRIMARY KEY (version));
CREATE TABLE relit_idempotency (
    project VARCHAR(64) NOT NULL,
    token VARCHAR(255) NOT NULL,
    fingerprint VARCHAR(64) NOT NULL,
    made VARCHAR(32) NOT NULL,
    created_at FLOAT NOT NULL,
    PRIMARY KEY (project, token)
);
CREATE TABLE relit_intakes (
    id VARCHAR(32) NOT NULL,
    project VARCHAR(64) NOT NULL,
    kind VARCHAR(16) NOT NULL,
    name VARCHAR(200) NOT NULL,
    folder TEXT,
    state VARCHAR(16) NOT NULL,
    problem TEXT,
    facts JSON,
    created_at FLOAT NOT NULL,
    PRIMARY KEY (id)
);
CREATE INDEX relit_intakes_of_project ON relit_intakes (project, kind, created_at);
CREATE TABLE relit_jobs (
    id VARCHAR(32) NOT NULL,
    project VARCHAR(64) NOT NULL,
    key VARCHAR(32),
    request JSON NOT NULL,
    trace VARCHAR(64),
    chunk_frames INTEGER NOT NULL,
    priority INTEGER NOT NULL,
    state VARCHAR(16) NOT NULL,
    attempt INTEGER NOT NULL,
    revision BIGINT NOT NULL,
    created_at FLOAT NOT NULL,
    updated_at FLOAT NOT NULL,
    started_at FLOAT,
    finished_at FLOAT,
    worker VARCHAR(200),
    lost INTEGER NOT NULL,
    reached INTEGER NOT NULL,
    finished_steps JSON NOT NULL,
    stage VARCHAR(100),
    done INTEGER,
    total INTEGER,
    rate FLOAT,
    error TEXT,
    stages_begun JSON DEFAULT '[]' NOT NULL,
    repeating BOOLEAN DEFAULT false NOT NULL,
    lost_repeating INTEGER DEFAULT '0' NOT NULL,
    result_bytes BIGINT DEFAULT '0' NOT NULL,
    PRIMARY KEY (id)
);
CREATE INDEX relit_jobs_of_state ON relit_jobs (state, updated_at);
CREATE INDEX relit_jobs_of_project ON relit_jobs (project, created_at);
CREATE TABLE relit_keys (
    id VARCHAR(32) NOT NULL,
    project VARCHAR(64) NOT NULL,
    name VARCHAR(200) NOT NULL,
    scope VARCHAR(8) NOT NULL,
    digest VARCHAR(64) NOT NULL,
    created_at FLOAT NOT NULL,
    revoked_at FLOAT,
    expires_at FLOAT,
    used_at FLOAT,
    PRIMARY KEY (id)
);
CREATE TABLE relit_workers (
    id VARCHAR(200) NOT NULL,
    host VARCHAR(200) NOT NULL,
    pid INTEGER NOT NULL,
    device VARCHAR(100) NOT NULL,
    started_at FLOAT NOT NULL,
    seen_at FLOAT NOT NULL,
    state VARCHAR(16) NOT NULL,
    PRIMARY KEY (id)
);
CREATE TABLE relit_job_inputs (
    job VARCHAR(32) NOT NULL,
    input VARCHAR(32) NOT NULL,
    PRIMARY KEY (job, input),
    FOREIGN KEY(job) REFERENCES relit_jobs (id) ON DELETE CASCADE
);
CREATE INDEX ix_relit_job_inputs_input ON relit_job_inputs (input);
CREATE TABLE relit_uploads (
    id VARCHAR(32) NOT NULL,
    project VARCHAR(64) NOT NULL,
    intake VARCHAR(32) NOT NULL,
    path TEXT NOT NULL,
    folded TEXT <BYTEWISE> NOT NULL,
    length BIGINT NOT NULL,
    received BIGINT NOT NULL,
    sha256 VARCHAR(64),
    touched_at FLOAT NOT NULL,
    done BOOLEAN NOT NULL,
    writer VARCHAR(32),
    writer_until FLOAT,
    pieces JSON DEFAULT '[]' NOT NULL,
    PRIMARY KEY (id),
    CONSTRAINT relit_uploads_of_path UNIQUE (intake, folded),
    FOREIGN KEY(intake) REFERENCES relit_intakes (id)
);
CREATE TABLE relit_audit (
    id <LARGE NUMBER>,
    project VARCHAR(64) NOT NULL,
    at FLOAT NOT NULL,
    actor VARCHAR(200) NOT NULL,
    action VARCHAR(40) NOT NULL,
    object VARCHAR(40) NOT NULL,
    request VARCHAR(32),
    PRIMARY KEY (id)
);
CREATE INDEX relit_audit_of_project ON relit_audit (project, id);
CREATE TABLE relit_clock (id INTEGER NOT NULL, seen_at FLOAT NOT NULL, waits_s FLOAT NOT NULL, PRIMARY KEY (id));
CREATE TABLE relit_job_log (
    number <NUMBER>,
    job VARCHAR(32) NOT NULL,
    at FLOAT NOT NULL,
    attempt INTEGER NOT NULL,
    text TEXT NOT NULL,
    PRIMARY KEY (number),
    FOREIGN KEY(job) REFERENCES relit_jobs (id) ON DELETE CASCADE
);
CREATE INDEX ix_relit_job_log_job ON relit_job_log (job);
CREATE TABLE relit_streams (
    process VARCHAR(32) NOT NULL,
    project VARCHAR(64) NOT NULL,
    key VARCHAR(32) NOT NULL,
    open INTEGER NOT NULL,
    until FLOAT NOT NULL,
    PRIMARY KEY (process, project, key)
);
CREATE TABLE relit_rates (
    key VARCHAR(32) NOT NULL,
    tokens FLOAT NOT NULL,
    counted_at FLOAT NOT NULL,
    leases JSON NOT NULL,
    full_at FLOAT NOT NULL,
    PRIMARY KEY (key)
);
CREATE TABLE relit_schema (version_num VARCHAR(32) NOT NULL, PRIMARY KEY (version_num));

INSERT INTO relit_schema VALUES ('0009');
INSERT INTO relit_about VALUES (2);
INSERT INTO relit_keys VALUES ('key_0123456789abcdefghjk', 'larch', 'Ann B.', 'write',
    '9523d9fbe79bcf3ee5f9f664a8041fa3cdba4b6b8bb902cb5ec335a5bf1ca769', 1.7e9, NULL, NULL, 1.7e9);
INSERT INTO relit_intakes VALUES ('cap_0123456789abcdefghjk', 'larch', 'cap', 'owl', '/captures/owl', 'ready', NULL, '{"captures": 1}', 1.7e9);
INSERT INTO relit_intakes VALUES ('cap_1123456789abcdefghjk', 'larch', 'cap', 'jay', NULL, 'receiving', NULL, NULL, 1.7e9);
INSERT INTO relit_uploads VALUES ('upl_0123456789abcdefghjk', 'larch', 'cap_1123456789abcdefghjk', 'Capture.json', 'capture.json', 100, 40,
    NULL, 1.7e9, false, NULL, NULL, '[]');
INSERT INTO relit_jobs VALUES ('job_0123456789abcdefghjk', 'larch', 'key_0123456789abcdefghjk',
    '{"name": "", "priority": 50, "kind": "solve", "capture": "cap_0123456789abcdefghjk", "reference_ball": null, "options": {}}',
    NULL, 128, 50, 'succeeded', 1, 9, 1.7e9, 1.7e9, 1.7e9, 1.7e9, 'host-cpu-1-0', 0, 0, '["solve"]', 'solve', 3, 3, NULL, NULL, '["solve"]', false, 0, 1000);
INSERT INTO relit_jobs VALUES ('job_1123456789abcdefghjk', 'larch', 'key_0123456789abcdefghjk',
    '{"name": "", "priority": 60, "kind": "solve", "capture": "cap_0123456789abcdefghjk", "reference_ball": null, "options": {}}',
    NULL, 128, 60, 'queued', 2, 3, 1.7e9, 1.7e9, NULL, NULL, NULL, 2, 0, '[]', NULL, NULL, NULL, NULL, NULL, '[]', false, 0, 0);
INSERT INTO relit_job_inputs VALUES ('job_1123456789abcdefghjk', 'cap_0123456789abcdefghjk');
INSERT INTO relit_idempotency VALUES ('larch', 'once', 'f', 'job_0123456789abcdefghjk', 1.7e9);
INSERT INTO relit_workers VALUES ('host-cpu-1-0', 'host', 1, 'cpu', 1.7e9, 1.7e9, 'ready');
INSERT INTO relit_audit (project, at, actor, action, object) VALUES ('larch', 1.7e9, 'key_0123456789abcdefghjk', 'job.submit',
    'job_0123456789abcdefghjk');
INSERT INTO relit_job_log (job, at, attempt, text) VALUES ('job_0123456789abcdefghjk', 1.7e9, 1, 'succeeded');
