"""Views: the models of the answers of the service and the states in them, shared by the API and its client."""

from datetime import datetime
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

Time = Annotated[datetime, Field(description="UTC.")]


class View(BaseModel):
    """Base of every answer; the docstring of a field is its description in the OpenAPI document."""

    model_config = ConfigDict(use_attribute_docstrings=True)
