-- The database of relit 0.1 before there were migrations, with something in every table. It never changes.
-- <BYTEWISE> is COLLATE "C" on PostgreSQL, and nothing on SQLite.
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
    PRIMARY KEY (id),
    CONSTRAINT relit_uploads_of_path UNIQUE (intake, folded),
    FOREIGN KEY(intake) REFERENCES relit_intakes (id)
);

INSERT INTO relit_about VALUES (1);
INSERT INTO relit_keys VALUES ('key_0123456789abcdefghjk', 'larch', 'Ann B.', 'write',
    '9523d9fbe79bcf3ee5f9f664a8041fa3cdba4b6b8bb902cb5ec335a5bf1ca769', 1.7e9, NULL);
INSERT INTO relit_intakes VALUES ('cap_0123456789abcdefghjk', 'larch', 'cap', 'owl', '/captures/owl', 'ready', NULL, '{"captures": 1}', 1.7e9);
INSERT INTO relit_intakes VALUES ('cap_1123456789abcdefghjk', 'larch', 'cap', 'jay', NULL, 'receiving', NULL, NULL, 1.7e9);
INSERT INTO relit_uploads VALUES ('upl_0123456789abcdefghjk', 'larch', 'cap_1123456789abcdefghjk', 'Capture.json', 'capture.json', 100, 40,
    NULL, 1.7e9, false);
INSERT INTO relit_jobs VALUES ('job_0123456789abcdefghjk', 'larch', 'key_0123456789abcdefghjk',
    '{"name": "", "priority": 50, "kind": "solve", "capture": "cap_0123456789abcdefghjk", "reference_ball": null, "options": {}}',
    NULL, 128, 50, 'succeeded', 1, 9, 1.7e9, 1.7e9, 1.7e9, 1.7e9, 'host-cpu-1-0', 0, 0, '["solve"]', 'solve', 3, 3, NULL, NULL);
INSERT INTO relit_jobs VALUES ('job_1123456789abcdefghjk', 'larch', 'key_0123456789abcdefghjk',
    '{"name": "", "priority": 60, "kind": "solve", "capture": "cap_0123456789abcdefghjk", "reference_ball": null, "options": {}}',
    NULL, 128, 60, 'queued', 2, 3, 1.7e9, 1.7e9, NULL, NULL, NULL, 2, 0, '[]', NULL, NULL, NULL, NULL, NULL);
INSERT INTO relit_job_inputs VALUES ('job_1123456789abcdefghjk', 'cap_0123456789abcdefghjk');
INSERT INTO relit_idempotency VALUES ('larch', 'once', 'f', 'job_0123456789abcdefghjk', 1.7e9);
INSERT INTO relit_workers VALUES ('host-cpu-1-0', 'host', 1, 'cpu', 1.7e9, 1.7e9, 'ready');
