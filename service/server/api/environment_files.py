"""The route that sends the image of an environment, which the pages light objects with."""

import os
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Annotated

from fastapi import APIRouter, Depends, Response

from service.requests.identifiers import EnvironmentId
from service.server.api.context import Reader, ServiceDep
from service.server.api.intakes import row_of
from service.server.api.problems import ApiError, responses
from service.server.api.results import DOWNLOAD, IfRange, Opened, Tags, Wanted, download_result
from service.server.storage import layout
from service.views.states import READY
from stage import inputs
from stage.errors import StageError

router = APIRouter(prefix="/v1/environments", tags=["environments"], responses=responses(401, 403, 404, 409, 422, 429, 503))


def opened(service: ServiceDep, caller: Reader, environment: EnvironmentId) -> Iterator[Opened]:
    """Open the image of an environment until the answer has been sent.

    Raises:
        ApiError: the project has no such environment, it is not ready, or its file is not there any more.
    """
    row = row_of(service, caller, environment)
    if row["state"] != READY:
        raise ApiError("conflict", f"{environment} is {row['state']}, not ready")
    gone = ApiError("not-found", f"the file of {environment} is not there any more")
    with ExitStack() as held:
        if row["folder"] is None:
            prefix = layout.intake(caller.project, environment)
            found = [service.storage.open(prefix, file.name) for file in service.storage.files(prefix)]
            if len(found) != 1 or found[0] is None:
                raise gone
            path = found[0]
        else:
            path = Path(row["folder"])
            root = next((root for root in service.settings.roots_of(caller.project) if path.is_relative_to(root)), None)
            if root is None:
                raise gone
            try:
                held.enter_context(inputs.confined(path.parent, root))
            except StageError:
                raise gone from None
        try:
            file = held.enter_context(inputs.opened(path)).file
        except StageError:
            raise gone from None
        status = os.fstat(file.fileno())
        etag = f'"{status.st_ino:x}-{status.st_mtime_ns:x}-{status.st_size:x}"'
        yield Opened(path.name, file.fileno(), status.st_size, etag, status.st_mtime)


@router.get("/{environment}/file", responses=DOWNLOAD, response_class=Response, summary="Download the image of an environment")
async def download_environment(file: Annotated[Opened, Depends(opened)], if_match: Tags = None, if_none_match: Tags = None,
                               wanted: Wanted = None, if_range: IfRange = None) -> Response:
    """Send the image of an environment that is ready, or a part of it."""
    return await download_result(file, if_match, if_none_match, wanted, if_range)
