"""A job → files: one template with its values beside it, or a folder as Deadline Cloud takes it, a job bundle."""

from pathlib import Path
from typing import NamedTuple

from service.farm.document import yaml_text
from service.farm.parameters import Job
from stage.files import write_text

TEMPLATE_SUFFIXES = (".yaml", ".yml")


class Written(NamedTuple):
    """Where a job is."""

    template: Path
    values: Path
    is_bundle: bool


def write_job(made: Job, where: Path) -> Written:
    """Write a job.

    Args:
        made: the job.
        where: NAME.yaml, and NAME.values.yaml beside it; any other name is a folder, with template.yaml and parameter_values.yaml.

    Raises:
        StorageError: it cannot be written.
    """
    if where.suffix.lower() in TEMPLATE_SUFFIXES:
        written = Written(where, where.with_suffix(f".values{where.suffix}"), False)
        values = yaml_text(made.values)
    else:
        written = Written(where / "template.yaml", where / "parameter_values.yaml", True)
        values = yaml_text({"parameterValues": [{"name": name, "value": value} for name, value in made.values.items()]})
    write_text(written.values, values)
    write_text(written.template, yaml_text(made.template))
    return written
