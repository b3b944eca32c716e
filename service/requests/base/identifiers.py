"""Identifiers of captures, environments, uploads, jobs, keys and hooks: a prefix, and 20 random letters and digits; the default address."""

import json
import re
import secrets
from typing import Annotated, Any

from pydantic import BeforeValidator, StringConstraints

ALPHABET = "0123456789abcdefghjkmnpqrstvwxyz"
"""Crockford's base 32 in small letters: none that are mistaken for another."""
LENGTH = 20
DEFAULT_PORT = 8470
DEFAULT_SERVER = f"http://127.0.0.1:{DEFAULT_PORT}"
"""The address at which a client looks for the service, where nothing else is given."""
PROJECT_PATTERN = r"^[a-z0-9][a-z0-9-]{0,62}$"
PROJECT_WORDS = "give 1 to 63 of a-z, 0-9 and -, not - first, as in my-owls"

CAPTURE, ENVIRONMENT, UPLOAD, JOB, KEY, HOOK, DELIVERY, ANNOTATION = "cap", "env", "up", "job", "key", "hook", "msg", "ann"


def new_id(prefix: str) -> str:
    """Return a new identifier: a prefix and 100 random bits."""
    return f"{prefix}_" + "".join(secrets.choice(ALPHABET) for _ in range(LENGTH))


def pattern(prefix: str) -> str:
    """Return the regular expression of the identifiers with a prefix."""
    return f"^{prefix}_[{ALPHABET}]{{{LENGTH}}}$"


def matching(pattern: str, words: str) -> BeforeValidator:
    """Return what says in words how a text is given that does not match a pattern, in place of the pattern."""
    expression = re.compile(pattern)

    def check(value: Any) -> Any:
        if isinstance(value, str) and not expression.search(value):
            raise ValueError(f"is {json.dumps(value[:200], ensure_ascii=False)}: {words}")
        return value

    return BeforeValidator(check)


CaptureId = Annotated[str, StringConstraints(pattern=pattern(CAPTURE))]
EnvironmentId = Annotated[str, StringConstraints(pattern=pattern(ENVIRONMENT))]
UploadId = Annotated[str, StringConstraints(pattern=pattern(UPLOAD))]
JobId = Annotated[str, StringConstraints(pattern=pattern(JOB))]
AnnotationId = Annotated[str, StringConstraints(pattern=pattern(ANNOTATION))]
HookId = Annotated[str, StringConstraints(pattern=pattern(HOOK))]
Project = Annotated[str, StringConstraints(pattern=PROJECT_PATTERN), matching(PROJECT_PATTERN, PROJECT_WORDS)]
