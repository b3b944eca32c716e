"""Hooks: set, looked at, tested and deleted, with a key of scope admin."""

from service.client.connection import Connection
from service.requests.answers import DeliveryView, HookList, HookView, NewHookView
from service.requests.hooks import NewHook

PATH = "/v1/hooks"


class Hooks:
    """The hooks of a project."""

    def __init__(self, connection: Connection) -> None:
        self._connection = connection

    def create(self, wanted: NewHook) -> NewHookView:
        """Create a hook, and return it with its secret, which is not shown again."""
        answer = self._connection.send("POST", PATH, json=wanted.model_dump(mode="json"), repeatable=False)
        return NewHookView.model_validate_json(answer.content)

    def all(self) -> list[HookView]:
        """Return the hooks of the project, the oldest first."""
        return HookList.model_validate_json(self._connection.send("GET", PATH).content).hooks

    def get(self, hook: str) -> HookView:
        """Return one hook."""
        return HookView.model_validate_json(self._connection.send("GET", self._connection.path(PATH, hook)).content)

    def test(self, hook: str) -> DeliveryView:
        """Queue a delivery of the type hook.test; `get` tells what came of it."""
        answer = self._connection.send("POST", f"{self._connection.path(PATH, hook)}/test", repeatable=False)
        return DeliveryView.model_validate_json(answer.content)

    def delete(self, hook: str) -> None:
        """Delete a hook; what waits is not sent any more."""
        self._connection.send("DELETE", self._connection.path(PATH, hook), repeatable=False)
