"""What `relit gauge-board` takes."""

from pathlib import Path
from typing import Annotated

from service.requests.base import Options, Role, Spelling


class GaugeBoardRequest(Options):
    """Repeatability and reproducibility of inspections of the same boards (gauge R&R)."""

    study: Annotated[Path, Role.INPUT, Spelling(argument=True, metavar="STUDY")]
    """The study: which result of relit inspect-board is of which board and operator (JSON, schema relit.gauge-study/1)."""
    out: Annotated[Path, Role.OUTPUT]
    """Folder for gauge.csv and report.json."""
