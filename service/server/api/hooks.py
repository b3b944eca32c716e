"""Routes of hooks: set a URL that is told how the jobs of the project have ended, look at it, test it, delete it."""

from typing import Annotated

import sqlalchemy as sa
from fastapi import APIRouter, Body, Path, Response

from service.requests.answers import DeliveryView, HookList, HookView, NewHookView
from service.requests.base.identifiers import HookId
from service.requests.hooks import NewHook
from service.server.api.context import Admin, Service, ServiceDep
from service.server.api.jobs import StrictJson
from service.server.api.json_body import JsonRoute
from service.server.api.limits import CREATION_COST
from service.server.api.problems import found_in_project, responses
from service.server.base import outgoing
from service.server.database import audit, hooks, quotas

router = APIRouter(prefix="/v1/hooks", tags=["hooks"], responses=responses(401, 403, 422, 429, 503), route_class=JsonRoute)

HookName = Annotated[HookId, Path(description="Identifier of the hook.")]
Wanted = Annotated[NewHook, StrictJson(NewHook), Body(openapi_examples={
    "ends": {"value": {"url": "https://tracker.example/relit"}},
    "failures": {"value": {"url": "https://chat.example/relit", "events": ["failed"]}}})]


@router.post("", status_code=201, summary="Create a hook")
def create_hook(service: ServiceDep, caller: Admin, response: Response, wanted: Wanted) -> NewHookView:
    """Let the URL be told by a signed request (Standard Webhooks) when jobs of the project end. The secret is in this answer alone."""
    outgoing.require_target(wanted.url, service.settings.hook_networks)
    service.limiter.take(caller.key, CREATION_COST - 1)
    with service.database.begin() as connection:
        quotas.require(connection, service.settings, quotas.HOOKS, caller.project, 1)
        row = hooks.insert(connection, caller.project, wanted)
        audit.record(connection, caller, "hook.create", row["id"])
    response.headers["Location"] = f"/v1/hooks/{row['id']}"
    return NewHookView.model_validate({**row, "waiting": 0, "last_delivery": None})


@router.get("", summary="List the hooks of the project")
def list_hooks(service: ServiceDep, caller: Admin) -> HookList:
    """List the hooks of the project, the oldest first, each with the delivery that was tried last."""
    return HookList(hooks=[_view(service, row) for row in hooks.listing(service.database, caller.project)])


@router.get("/{hook}", responses=responses(404), summary="Look at a hook")
def get_hook(service: ServiceDep, caller: Admin, hook: HookName) -> HookView:
    """Return a hook, how many deliveries wait, and the one that was tried last."""
    return _view(service, found_in_project(next(iter(hooks.listing(service.database, caller.project, hook)), None), hook))


@router.post("/{hook}/test", status_code=202, responses=responses(404), summary="Send a test to a hook")
def send_test(service: ServiceDep, caller: Admin, hook: HookName) -> DeliveryView:
    """Queue a delivery of the type `hook.test`, which is signed, sent and tried again as the others are, and end the pause of the hook."""
    service.limiter.take(caller.key, CREATION_COST - 1)
    with audit.recorded(service.database, caller, "hook.test", hook) as connection:
        made = found_in_project(hooks.record_test(connection, caller.project, hook), hook)
    return DeliveryView.model_validate(dict(made))


@router.delete("/{hook}", status_code=204, responses=responses(404), summary="Delete a hook")
def delete_hook(service: ServiceDep, caller: Admin, hook: HookName) -> None:
    """Delete a hook; deliveries that wait are not sent any more."""
    with audit.recorded(service.database, caller, "hook.delete", hook) as connection:
        found_in_project(hooks.remove(connection, caller.project, hook) or None, hook)


def _view(service: Service, row: sa.RowMapping) -> HookView:
    last = hooks.last_delivery(service.database, row["id"])
    return HookView.model_validate({**row, "waiting": hooks.count_waiting(service.database, row["id"]),
                                    "last_delivery": None if last is None else dict(last)})
