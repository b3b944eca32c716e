"""OpenID Connect: bearer tokens of the operator's identity provider, beside keys.

A token is a JWT that the provider signed. It names its user, and in one claim the groups that `oidc_grants` maps to projects and scopes.
The provider's public keys are found by its discovery document (OpenID Connect Discovery 1.0) and kept; a token signed with a key that is
not among them makes the service look for new keys, so that a provider may change them at any time.
"""

import hashlib
import importlib.util
import threading
import time
from typing import Any

import httpx2

from service.errors import RequestError
from service.requests.keys import Scope
from service.server.api.problems import RETRY_S, ApiError
from service.server.base.log import logger
from service.server.base.settings import Settings
from service.server.database.keys import ORDER, Caller

ALGORITHMS = ("RS256", "RS384", "RS512", "PS256", "PS384", "PS512", "ES256", "ES384", "ES512", "Ed25519", "EdDSA")
"""Signatures with a private key; never `none`, and none with a secret that the service would have to share."""
KEEP_S = 3600.0
"""Seconds after which the provider's keys are fetched again."""
STALE_S = 86_400.0
"""Seconds for which keys are used while the provider cannot be reached."""
AGAIN_S = 30.0
"""Seconds between two requests to the provider at least, whatever tokens are sent."""
TIMEOUT_S = 5.0
MAX_BYTES = 1 << 20
LEEWAY_S = 60
"""Seconds by which the clocks of the service and the provider may differ."""
PROJECT_HEADER = "Relit-Project"
"""Names the project of a request whose token allows several."""


class TokenReader:
    """Reads tokens of one provider."""

    def __init__(self, settings: Settings) -> None:
        if importlib.util.find_spec("joserfc") is None:
            raise RequestError("oidc_issuer: tokens need the extra oidc: pip install 'relit[oidc]'")
        self._settings = settings
        self._lock = threading.Lock()
        self._keys: Any = None
        self._fetched_at = self._tried_at = -STALE_S

    def caller(self, token: str, project: str | None) -> Caller | None:
        """Return who sent a token, in the project that the request names if the token allows several; None: the token is not valid."""
        claims = self._claims(token)
        if claims is None:
            return None
        values = claims.get(self._settings.oidc_claim, [])
        values = [values] if isinstance(values, str) else values
        granted: dict[str, Scope] = {}
        for grant in self._settings.oidc_grants:
            if isinstance(values, list) and grant.value in values:
                granted[grant.project] = max(granted.get(grant.project, Scope.READ), grant.scope, key=ORDER.index)
        if not granted or (project is not None and project not in granted):
            raise ApiError("forbidden", "the token allows no project" if project is None else f"the token does not allow {project}")
        if project is None and len(granted) > 1:
            raise ApiError("forbidden", f"the token allows {', '.join(sorted(granted))}: name one in the header {PROJECT_HEADER}")
        chosen = project or next(iter(granted))
        user = hashlib.sha256(f"{claims['iss']} {claims['sub']}".encode()).hexdigest()  # the same for all tokens of a user
        return Caller(chosen, granted[chosen], f"oidc_{user[:20]}", float(claims["exp"]))

    def _claims(self, token: str) -> dict[str, Any] | None:
        from joserfc import jws, jwt
        from joserfc.errors import JoseError

        now = int(time.time())
        rules = jwt.JWTClaimsRegistry(now=now, leeway=LEEWAY_S, iss={"essential": True, "value": str(self._settings.oidc_issuer)},
                                      aud={"essential": True, "value": self._settings.oidc_audience},
                                      exp={"essential": True}, sub={"essential": True})
        try:
            header = jws.extract_compact(token.encode()).headers()
            keys = self._provider_keys(str(header.get("kid")))
            claims = jwt.decode(token, keys, algorithms=list(ALGORITHMS)).claims
            rules.validate(claims)
        except (JoseError, ValueError, TypeError):  # whatever is wrong with it, whoever sent it learns no more than that
            return None
        return claims

    def _provider_keys(self, kid: str) -> Any:
        with self._lock:
            now = time.monotonic()
            unknown = self._keys is None or kid not in {key.kid for key in self._keys.keys}
            if (unknown or now - self._fetched_at > KEEP_S) and now - self._tried_at >= AGAIN_S:
                self._tried_at = now
                try:
                    self._keys = self._fetch()
                    self._fetched_at = now
                except (httpx2.HTTPError, ValueError, KeyError, TypeError) as error:
                    logger.warning("identity provider does not answer", issuer=self._settings.oidc_issuer, error=str(error))
            if self._keys is None or now - self._fetched_at > STALE_S:
                raise ApiError("unavailable", "the identity provider does not answer: try again", headers={"Retry-After": str(RETRY_S)})
            return self._keys

    def _fetch(self) -> Any:
        from joserfc.errors import JoseError
        from joserfc.jwk import KeySet

        issuer = str(self._settings.oidc_issuer)
        with httpx2.Client(timeout=TIMEOUT_S) as client:
            found = _json(client, f"{issuer.rstrip('/')}/.well-known/openid-configuration")
            if found["issuer"] != issuer:
                raise ValueError(f"the discovery document is that of {found['issuer']}")
            try:
                return KeySet.import_key_set(_json(client, found["jwks_uri"]))
            except JoseError as error:
                raise ValueError(f"its keys cannot be read ({error})") from error


def _json(client: httpx2.Client, url: str) -> Any:
    with client.stream("GET", url) as answer:
        answer.raise_for_status()
        body = b""
        for piece in answer.iter_bytes():
            body += piece
            if len(body) > MAX_BYTES:
                raise ValueError(f"{url} answers with more than {MAX_BYTES} bytes")
    return httpx2.Response(200, content=body).json()
