"""Bodies taken as JSON says them: a number is a number, true is true, and "5" is neither.

FastAPI hands Pydantic Python objects, of which it takes "5" for 5 and 1 for true; the OpenAPI document promises otherwise. Pydantic's
strict mode keeps that promise for JSON text alone: of Python objects it refuses every list for a tuple and every text for an enumeration.
"""

import json
from typing import Any

from pydantic import GetCoreSchemaHandler, TypeAdapter
from pydantic_core import CoreSchema, core_schema


class Exact:
    """Annotation: read as this type, and by the letter."""

    def __init__(self, kind: Any) -> None:
        """Args: kind: a type; the annotated one is for readers, and a base of it."""
        self._kind, self._adapter = kind, TypeAdapter[Any](kind)

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        """That of the type, but for how values are read."""
        return core_schema.no_info_wrap_validator_function(
            lambda value, _: self._adapter.validate_json(json.dumps(value), strict=True), handler.generate_schema(self._kind))
