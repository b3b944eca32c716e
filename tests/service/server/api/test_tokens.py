"""Tokens of an identity provider: a local one, which signs, changes its keys, and is away."""

import base64
import hmac
import json
import time
from collections.abc import Iterator
from functools import cache

import pytest
from fastapi.testclient import TestClient
from joserfc import jwt
from joserfc.jwk import KeySet, RSAKey

from service.requests.keys import Scope
from service.server.api import tokens
from service.server.api.problems import ApiError
from service.server.api.tokens import TokenReader
from service.server.base.settings import Settings
from service.server.database import audit
from tests.service.answering import Asked, answering
from tests.service.server.api.asgi import app_of

GRANTS = "artists=larch:write,td=larch:admin,guests=willow:read"


@cache
def rsa_key(name: str) -> RSAKey:
    """A key pair of this name, which takes long to make."""
    return RSAKey.generate_key(2048, {"kid": name})


class Issuer:
    """An identity provider on loopback."""

    def __init__(self) -> None:
        self.keys = KeySet([rsa_key("one")])
        self.requests: list[str] = []
        self.url = ""

    def answer(self, asked: Asked) -> tuple[int, bytes]:
        self.requests.append(asked.path)
        return 200, json.dumps({"/.well-known/openid-configuration": {"issuer": self.url, "jwks_uri": f"{self.url}/keys"},
                                "/keys": self.keys.as_dict(private=False)}[asked.path]).encode()

    def token(self, *, key=None, algorithm: str = "RS256", **claims: object) -> str:
        key = key or self.keys.keys[-1]
        now = int(time.time())
        values = {"iss": self.url, "aud": "relit", "sub": "ann", "exp": now + 600, "groups": ["artists"]} | claims
        return jwt.encode({"alg": algorithm, "kid": key.kid}, {name: value for name, value in values.items() if value is not None}, key,
                          algorithms=[algorithm])

    def rotate(self) -> None:
        self.keys = KeySet([rsa_key("two")])


@pytest.fixture
def issuer() -> Iterator[Issuer]:
    made = Issuer()
    with answering(made.answer) as made.url:
        yield made


@pytest.fixture
def reader(issuer, tmp_path) -> TokenReader:
    return TokenReader(Settings(data=tmp_path, oidc_issuer=issuer.url, oidc_grants=GRANTS))


def test_a_token_gives_the_project_and_the_scope_of_its_groups(issuer, reader):
    caller = reader.caller(issuer.token(), None)
    assert (caller.project, caller.scope, caller.key[:5]) == ("larch", Scope.WRITE, "oidc_")
    assert caller.until == pytest.approx(time.time() + 600, abs=60)
    assert reader.caller(issuer.token(groups=["td", "artists", "others"]), None).scope == Scope.ADMIN
    assert reader.caller(issuer.token(groups="guests"), None)[:2] == ("willow", Scope.READ)
    assert reader.caller(issuer.token(sub="bob"), None).key != caller.key == reader.caller(issuer.token(groups="td"), None).key
    assert issuer.requests == ["/.well-known/openid-configuration", "/keys"]  # once for all
    token = issuer.token(groups=["artists", "guests"])
    assert reader.caller(token, "willow")[:2] == ("willow", Scope.READ)
    with pytest.raises(ApiError, match="the token allows larch, willow: name one in the header"):
        reader.caller(token, None)
    with pytest.raises(ApiError, match="the token does not allow oak"):
        reader.caller(token, "oak")


@pytest.mark.parametrize("groups", [[], ["others"], None, 7, {"artists": 1}, [7]])
def test_a_token_without_a_group_that_counts_allows_nothing(issuer, reader, groups):
    with pytest.raises(ApiError, match="the token allows no project"):
        reader.caller(issuer.token(groups=groups), None)


@pytest.mark.parametrize("claims", [{"aud": "another"}, {"aud": None}, {"iss": "http://127.0.0.1:1"}, {"exp": int(time.time()) - 3600},
                                    {"exp": None}, {"sub": None}, {"nbf": int(time.time()) + 3600}])
def test_claims_that_do_not_hold(issuer, reader, claims):
    assert reader.caller(issuer.token(**claims), None) is None


def test_signatures_that_do_not_hold(issuer, reader):
    another = RSAKey.generate_key(2048, {"kid": "one"})
    assert reader.caller(issuer.token(key=another), None) is None
    # the public key, taken for a secret
    head, body, _ = issuer.token().split(".")
    forged = base64.urlsafe_b64encode(b'{"alg":"HS256","kid":"one"}').decode().rstrip("=") + f".{body}"
    digest = hmac.digest(issuer.keys.keys[0].as_pem(private=False), forged.encode(), "sha256")
    assert reader.caller(f"{forged}.{base64.urlsafe_b64encode(digest).decode().rstrip('=')}", None) is None
    for text in (f"{head}.{body}.", f"eyJhbGciOiJub25lIn0.{body}.", "a.b.c", "..", f"{head}.{body}.{'A' * 342}"):
        assert reader.caller(text, None) is None
    assert reader.caller(issuer.token(), None) is not None


def test_the_provider_may_change_its_keys(issuer, reader, monkeypatch):
    old = issuer.token()
    assert reader.caller(old, None)
    issuer.rotate()
    assert reader.caller(issuer.token(), None) is None  # it was asked a moment ago
    monkeypatch.setattr(tokens, "AGAIN_S", 0.0)
    assert reader.caller(issuer.token(), None)
    assert reader.caller(old, None) is None


def test_tokens_with_unknown_keys_do_not_flood_the_provider(issuer, reader):
    assert reader.caller(issuer.token(), None)
    unknown = RSAKey.import_key(rsa_key("two").as_dict(private=True) | {"kid": "unknown"})
    assert [reader.caller(issuer.token(key=unknown), None) for _ in range(20)] == [None] * 20
    assert len(issuer.requests) == 2


def test_a_provider_that_is_away(tmp_path, monkeypatch):
    monkeypatch.setattr(tokens, "KEEP_S", 0.0)
    monkeypatch.setattr(tokens, "AGAIN_S", 0.0)
    issuer = Issuer()
    with answering(issuer.answer) as issuer.url:
        settings = Settings(data=tmp_path, oidc_issuer=issuer.url, oidc_grants=GRANTS)
        known, fresh = TokenReader(settings), TokenReader(settings)
        token = issuer.token()
        assert known.caller(token, None)
    assert known.caller(token, None)  # by the keys that it has
    with pytest.raises(ApiError, match="the identity provider does not answer"):
        fresh.caller(token, None)
    monkeypatch.setattr(tokens, "STALE_S", 0.0)
    with pytest.raises(ApiError, match="the identity provider does not answer"):
        known.caller(token, None)


def test_a_service_takes_tokens_beside_keys_and_audits_both(issuer, tmp_path):
    with app_of(Settings(data=tmp_path, min_free_bytes=0, oidc_issuer=issuer.url, oidc_grants=GRANTS)) as app:
        def holding(token: str) -> TestClient:
            return TestClient(app, headers={"Authorization": f"Bearer {token}"})

        with holding(issuer.token()) as client:
            made = client.post("/v1/captures", json={"name": "owl"})
            assert made.status_code == 201
            assert client.get("/v1/captures").json()["items"][0]["id"] == made.json()["id"]
            assert client.post("/v1/captures", json={"name": "owl", "folder": "/"}).status_code == 403  # needs admin
        with holding(issuer.token(groups=["guests"])) as other:
            assert other.get("/v1/captures").json()["items"] == []
            assert other.post("/v1/captures", json={"name": "owl"}).status_code == 403
        with holding(issuer.token(exp=1)) as late:
            answer = late.get("/v1/captures")
            assert (answer.status_code, answer.headers["WWW-Authenticate"]) == (401, "Bearer")
        line = audit.listing(app.state.service.database, limit=1)[0]
        assert (line["project"], line["action"], line["object"]) == ("larch", "intake.create", made.json()["id"])
        assert line["actor"].startswith("oidc_") and line["request"] == made.headers["X-Request-ID"]
