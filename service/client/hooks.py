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
        return self._connection.ask(NewHookView, "POST", PATH, json=wanted.model_dump(mode="json"), repeatable=False)

    def all(self) -> list[HookView]:
        """Return the hooks of the project, the oldest first."""
        return self._connection.ask(HookList, "GET", PATH).hooks

    def get(self, hook: str) -> HookView:
        """Return one hook."""
        return self._connection.ask(HookView, "GET", self._connection.path(PATH, hook))

    def test(self, hook: str) -> DeliveryView:
        """Queue a delivery of the type hook.test; `get` tells what came of it."""
        return self._connection.ask(DeliveryView, "POST", f"{self._connection.path(PATH, hook)}/test", repeatable=False)

    def delete(self, hook: str) -> None:
        """Delete a hook; what waits is not sent any more."""
        self._connection.send("DELETE", self._connection.path(PATH, hook), repeatable=False)
