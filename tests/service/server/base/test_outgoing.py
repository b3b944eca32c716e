"""Where requests to the URLs of users go, and where they do not."""

import socket
import ssl
import threading

import pytest

from service.errors import RequestError
from service.server.base import outgoing
from service.server.base.outgoing import NO_ADDRESS, post, require_target
from tests.service.server.receiver import receiving
from tests.service.server.test_nginx import write_certificate

PRIVATE = ["127.0.0.1", "10.1.2.3", "172.16.0.1", "192.168.1.1", "169.254.169.254", "100.64.0.1", "0.0.0.0", "224.0.0.1", "255.255.255.255",
           "[::1]", "[::]", "[fe80::1]", "[fc00::1]", "[ff02::1]", "[::ffff:127.0.0.1]", "[::ffff:10.0.0.1]", "[64:ff9b::7f00:1]",
           "[2002:7f00:1::]", "[2002:a00:1::]", "[::127.0.0.1]", "[::ffff:0:7f00:1]", "[64:ff9b:1::7f00:1]", "[fec0::1]", "[100::1]",
           "[2001:0:7f00:1::]"]
resolve = socket.getaddrinfo


def named(monkeypatch, *answers: list[str]) -> list[str]:
    """Let the names below .test have these addresses, one list after the other; return the names that were asked for."""
    asked, left = [], list(answers)

    def look_up(host, port, *rest, **more):
        if not str(host).endswith(".test"):
            return resolve(host, port, *rest, **more)
        asked.append(host)
        return [place for address in (left.pop(0) if len(left) > 1 else left[0]) for place in resolve(address, port, *rest, **more)]

    monkeypatch.setattr(socket, "getaddrinfo", look_up)
    return asked


@pytest.mark.parametrize("host", PRIVATE)
def test_addresses_that_are_not_public_are_refused_as_numbers_and_behind_names(host, monkeypatch):
    with pytest.raises(RequestError, match=r"is not a public address.* hook_networks"):
        require_target(f"https://{host}/x", ())
    named(monkeypatch, [host.strip("[]")])
    assert post("https://hook.test/x", b"", {}, ()) == (False, NO_ADDRESS)


@pytest.mark.parametrize("url", ["https://", "https:///x", "https://user:word@host/", "https://host:port/", "https://[::1/", "https://@host/",
                                 "https://a..b/", f"https://{'a' * 64}.example/"])
def test_urls_without_a_host_or_with_a_password_are_refused(url):
    with pytest.raises(RequestError, match="is not of the form https://host/path"):
        require_target(url, ("0.0.0.0/0",))


def test_public_addresses_are_taken_with_tls_alone():
    for host in ("93.184.215.14", "[2606:2800:21f:cb07:6820:80da:af6b:8b2c]", "tracker.example"):
        require_target(f"https://{host}/x", ())
    with pytest.raises(RequestError, match="http:// is for networks of the setting hook_networks"):
        require_target("http://93.184.215.14/x", ())


def test_other_spellings_of_an_address_are_resolved_and_refused():
    for host in ("127.1", "2130706433", "0x7f000001", "localhost"):
        require_target(f"https://{host}/x", ())  # a name, as it seems
        assert post(f"https://{host}/x", b"", {}, ()) == (False, NO_ADDRESS)


def test_users_do_not_learn_which_names_there_are_inside_and_the_operator_does(monkeypatch):
    logged = []
    monkeypatch.setattr(outgoing.logger, "info", lambda _event, **fields: logged.append(f"{fields['host']} {fields['error']}"))
    named(monkeypatch, ["10.1.2.3"])
    assert post("https://vault.test/", b"", {}, ()) == (False, NO_ADDRESS)

    def unknown(*_: object, **__: object) -> None:
        raise socket.gaierror(socket.EAI_NONAME, "Name or service not known")

    monkeypatch.setattr(socket, "getaddrinfo", unknown)
    assert post("https://nothing.test/", b"", {}, ()) == (False, NO_ADDRESS)
    assert "vault.test url: 10.1.2.3 is not a public address" in logged[0] and "nothing.test" in logged[1] and "not known" in logged[1]


def test_a_name_server_that_does_not_answer_is_not_waited_for(monkeypatch):
    held, ended = threading.Event(), threading.Event()

    def look_up(*_: object, **__: object) -> list:
        held.wait(60)
        ended.set()
        return []

    monkeypatch.setattr(socket, "getaddrinfo", look_up)
    monkeypatch.setattr(outgoing, "TIMEOUT_S", 0.1)
    assert post("https://hook.test/", b"", {}, ()) == (False, "no answer within 0.1 s")
    assert not ended.is_set()
    held.set()
    ended.wait(60)


def test_a_name_that_points_elsewhere_after_it_was_checked_leads_nowhere(monkeypatch):
    """The first answer is allowed; the second, for whoever asks again to connect, is not."""
    with receiving("127.0.0.2") as allowed, receiving("127.0.0.3", int(allowed.url.split(":")[2].split("/")[0])) as forbidden:
        asked = named(monkeypatch, ["127.0.0.2"], ["127.0.0.3"])
        url = allowed.url.replace("127.0.0.2", "hook.test")
        assert post(url, b"{}", {}, ("127.0.0.2/32",)) == (True, "204")
        assert asked == ["hook.test"] and forbidden.received == []
        assert allowed.received[0].headers["host"] == url.split("/")[2]
        refused = post(url, b"{}", {}, ("127.0.0.2/32",))
        assert refused == (False, NO_ADDRESS) and forbidden.received == []


def test_a_name_of_which_one_address_is_private_is_refused_and_the_next_address_is_tried(monkeypatch):
    with receiving("127.0.0.2") as receiver:
        url = receiver.url.replace("127.0.0.2", "hook.test")
        named(monkeypatch, ["127.0.0.2", "127.0.0.9"])
        assert not post(url, b"", {}, ("127.0.0.2/32",)).accepted and receiver.received == []
        named(monkeypatch, ["127.0.0.9", "127.0.0.2"])
        assert post(url, b"", {}, ("127.0.0.0/8",)).accepted


def test_the_certificate_is_that_of_the_name_and_not_of_the_address(monkeypatch, tmp_path):
    certificate, key = write_certificate(tmp_path)
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(certificate, key)
    asked: list[str | None] = []
    context.sni_callback = lambda _socket, name, _context: asked.append(name)
    monkeypatch.setenv("SSL_CERT_FILE", str(certificate))
    outgoing._certificates.cache_clear()
    with receiving(tls=context) as receiver:
        named_url = receiver.url.replace("127.0.0.1", "localhost").replace("http:", "https:")
        assert post(named_url, b"{}", {}, ("127.0.0.0/8", "::1/128")).accepted
        assert asked[-1] == "localhost"
        assert "certificate" in post(named_url.replace("localhost", "127.0.0.1"), b"{}", {}, ("127.0.0.0/8",)).words.lower()
    outgoing._certificates.cache_clear()


def test_proxies_and_redirects_are_not_followed_and_endless_answers_end(monkeypatch):
    with receiving() as receiver, receiving() as proxy, socket.create_server(("127.0.0.1", 0)) as endless:
        monkeypatch.setenv("HTTP_PROXY", proxy.url)
        receiver.status = 307
        assert post(receiver.url, b"", {}, ("127.0.0.0/8",)) == (False, "307: redirects are not followed")
        assert len(receiver.received) == 1 and proxy.received == []
        monkeypatch.setattr(outgoing, "TIMEOUT_S", 0.3)
        url = f"http://127.0.0.1:{endless.getsockname()[1]}/"
        assert post(url, b"", {}, ("127.0.0.0/8",)) == (False, "no answer within 0.3 s")
