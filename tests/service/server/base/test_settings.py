"""Settings: where they come from, what is refused, and that docs/service.md lists every one."""

import re
import subprocess
import sys
from pathlib import Path

import pytest
from pydantic import ValidationError

from service.errors import RequestError, sentence
from service.requests.demo import sample_folder
from service.server.base.settings import Settings, unknown_variables
from service.server.database.engine import open_database
from service.server.jobs.queue import prepare

DOCS = Path(__file__).parents[4] / "docs" / "service.md"


@pytest.fixture(autouse=True)
def bare(monkeypatch):
    """No setting of the machine that runs the tests."""
    for name in Settings.model_fields:
        monkeypatch.delenv(f"RELIT_{name.upper()}", raising=False)
    monkeypatch.delenv("RELIT_CONFIG", raising=False)


def test_docs_have_every_setting_with_default_and_meaning():
    rows = re.findall(r"^\| `(\w+)` \| (.*?) \| (.*?) \|$", DOCS.read_text(encoding="utf-8"), re.MULTILINE)
    assert [name for name, _, _ in rows] == list(Settings.model_fields)
    for name, default, meaning in rows:
        field = Settings.model_fields[name]
        assert default == shown(field.default), name
        assert meaning == field.description, name


def shown(default: object) -> str:
    """A default as the table writes it."""
    if default is None or default == ():
        return "–"
    if isinstance(default, int) and not isinstance(default, bool) and default >= 1024**3 and default % 1024**3 == 0:
        return f"`{default}` ({default // 1024**3} GiB)"
    return f"`{str(default).lower() if isinstance(default, bool) else f'{default:g}' if isinstance(default, float) else default}`"


def test_arguments_go_before_the_environment_and_that_before_the_file_which_has_to_be_there(monkeypatch, tmp_path):
    file = tmp_path / "relit.toml"
    file.write_text('port = 1\nhost = "::1"\nlog_level = "debug"\nroots = ["/a", "/b"]\n')
    monkeypatch.setenv("RELIT_PORT", "2")
    monkeypatch.setenv("RELIT_HOST", "localhost")
    assert Settings().port == 2
    settings = Settings(config=file, port=3)
    assert (settings.port, settings.host, settings.log_level) == (3, "localhost", "debug")
    assert settings.roots == (Path("/a"), Path("/b"))
    monkeypatch.setenv("RELIT_CONFIG", str(file))
    assert (Settings().port, Settings().log_level) == (2, "debug")
    other = tmp_path / "other.toml"
    other.write_text('log_level = "error"\n')
    assert Settings(config=other).log_level == "error"
    with pytest.raises(RequestError, match="cannot be read"):
        Settings(config=tmp_path / "no.toml")
    monkeypatch.setenv("RELIT_CONFIG", str(tmp_path / "no.toml"))
    with pytest.raises(RequestError, match="cannot be read"):
        Settings()


def test_lists_of_the_environment_and_variables_that_are_no_settings(monkeypatch):
    monkeypatch.setenv("RELIT_ROOTS", "/a:/b/../c")
    monkeypatch.setenv("RELIT_DEVICES", "cuda:0, cuda:1")
    assert Settings().roots == (Path("/a"), Path("/c")) and Settings().devices == ("cuda:0", "cuda:1")
    monkeypatch.setenv("RELIT_ROOTS", "")
    assert Settings().roots == ()
    given = {"RELIT_PROT": "1", "RELIT_PORT": "1", "RELIT_CONFIG": "x", "RELIT_KEY": "x", "RELIT_SERVER": "x", "RELIT_TEST_DATA": "x",
             "RELIT_WEATHER": "1", "PATH": "x"}
    assert unknown_variables(given) == {"RELIT_PROT": "RELIT_PORT", "RELIT_WEATHER": None}


@pytest.mark.parametrize(("given", "words"), [
    ({"port": 65536}, "port: is 65536"), ({"port": "http"}, 'port: is "http"'), ({"max_queued": 0}, "max_queued: is 0"),
    ({"stall_s": "inf"}, "stall_s"), ({"requests_per_second": "nan"}, "requests_per_second"), ({"log_level": "loud"}, "log_level"),
    ({"devices": "cpu,none"}, "devices: none stands alone"), ({"otel_endpoint": "collector:4318"}, "otel_endpoint: collector:4318"),
    ({"otel_endpoint": "http://collector:x"}, "otel_endpoint: http://collector:x"),
    *(({"oidc_issuer": url}, f"oidc_issuer: {url} is no https:// address") for url in
      ("https://idp.studio:x", "http://idp.studio", "idp.studio")),
    *(({"oidc_grants": grant}, "give VALUE=PROJECT:SCOPE") for grant in ("artists", "artists=larch:root", "artists=../x:read")),
    *(({"project_quotas": quota}, "give PROJECT:QUOTA=NUMBER") for quota in (
        "larch", "larch:max_project_jobs", "larch:max_frames=1", "larch:max_project_jobs=-1", "../x:max_project_jobs=1")),
    *(({"project_roots": root}, f"project_roots[0]: is {root}: give PROJECT=/folder") for root in ("larch", "=/l", "larch=", "Larch=/l")),
    *(({"anonymous": True, "host": host}, "anonymous: requests without a key are let in on loopback") for host in (
        "0.0.0.0", "::", "192.168.1.7", "relit.example.com", "127.0.0.1.example.com", "")),
    ({"retention_days": -1}, "retention_days"), ({"max_upload_bytes": "1e99"}, "max_upload_bytes"), ({"colour": 1}, "colour"),
])
def test_what_cannot_be_is_refused_by_name(given, words):
    with pytest.raises(ValidationError) as error:
        Settings(**given)
    assert words in sentence(error.value)


@pytest.mark.parametrize("given", [
    {"data": "/srv/relit", "roots": "/srv"}, {"data": "/srv/relit", "roots": "/"}, {"data": "/srv/relit", "roots": "/captures:/srv/relit"},
    {"data": "/srv/relit", "roots": "/srv/relit/projects"}, {"data": "/srv/relit", "project_roots": "larch=/srv"},
    {"data": "/srv/relit", "storage_url": "file:///mnt/store", "roots": "/mnt"}])
def test_a_root_that_holds_the_data_is_refused(tmp_path, given):
    """Else an administrator of one project registers the captures of the others, and receives their images."""
    with pytest.raises(ValidationError) as error:
        Settings(**given)
    assert "could register the captures of another" in sentence(error.value)
    Settings(**given | {"data": "/srv/relit", "roots": "/srv/captures:/srv/relit2", "project_roots": ""})
    (tmp_path / "data").mkdir()
    (tmp_path / "root").symlink_to(tmp_path)
    with pytest.raises(ValidationError):
        Settings(data=tmp_path / "data", roots=str(tmp_path / "root"))


def test_roots_of_projects(monkeypatch, tmp_path):
    monkeypatch.setenv("RELIT_ROOTS", "/shared")
    monkeypatch.setenv("RELIT_PROJECT_ROOTS", "larch=/l:birch=/b/../c:larch=/l=2")
    settings = Settings(data=tmp_path)
    always = tmp_path / "set", sample_folder()  # the captures of the page /set, and the sample
    assert settings.roots_of("larch") == (Path("/shared"), Path("/l"), Path("/l=2"), *always)
    assert settings.roots_of("birch") == (Path("/shared"), Path("/c"), *always) and settings.roots_of("oak") == (Path("/shared"), *always)


def test_no_key_is_asked_for_on_loopback_alone():
    assert all(Settings(host=local, anonymous=True).loopback for local in ("127.0.0.1", "127.1.2.3", "::1", "localhost"))
    assert not Settings(host="0.0.0.0").anonymous


@pytest.mark.parametrize(("text", "words"), [
    ("prot = 1", "there is no setting prot: is port meant?"), ("[port]\nx = 1", "port"), ("port = ", "is no TOML"), ("\xff", "is no TOML"),
    ("data = 7", "data"), ("anonymous = true\nhost = '0.0.0.0'", "anonymous"),
    ("colour_of_the_sky = 1", "there is no setting colour_of_the_sky"),
])
def test_a_wrong_file_is_one_sentence(relit, tmp_path, text, words):
    file = tmp_path / "relit.toml"
    file.write_bytes(text.encode("latin-1"))
    relit("serve", "--config", file).refused(words)


def test_a_port_of_the_database_that_is_no_number_is_one_sentence(tmp_path):
    settings = Settings(data=tmp_path, database_url="postgresql://relit:secret@localhost:x/relit")
    with pytest.raises(RequestError, match=r"^database_url: is not of the form (?!.*secret)"):
        open_database(settings, prepare)


@pytest.mark.long
@pytest.mark.parametrize(("arguments", "words"), [
    (["--data", "FILE", "--port", "0"], "data FILE: the folder cannot be used (File exists)"),
    (["--data", "NEW", "--port", "PORT"], "cannot listen on host 127.0.0.1, port PORT: Address already"),
    (["--data", "NEW", "--host", "no-such-name.invalid"], "cannot listen on host no-such-name.invalid"),
    (["--data", "NEW", "--port", "0", "--device", "cuda:99"], "cuda:99"),
], ids=["data", "port", "host", "device"])
def test_a_service_that_cannot_start_says_why(tmp_path, arguments, words):
    import socket

    (tmp_path / "file").write_text("")
    with socket.create_server(("127.0.0.1", 0)) as taken:
        names = {"FILE": str(tmp_path / "file"), "NEW": str(tmp_path / "new"), "PORT": str(taken.getsockname()[1])}

        def filled(text: str) -> str:
            return re.sub(r"FILE|NEW|PORT", lambda found: names[found[0]], text)

        done = subprocess.run([sys.executable, "-m", "service.cli.main", "serve", *map(filled, arguments)], capture_output=True, text=True,
                              timeout=120)
    assert done.returncode == 2 and done.stderr.count("\n") == 1, done.stderr
    assert done.stderr.startswith("relit: ") and filled(words) in done.stderr
