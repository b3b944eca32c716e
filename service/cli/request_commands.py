"""Commands made from request models: the only place that turns a model into options of the command line.

A command is a function that takes a request, does the work and prints what came of it. A parameter whose annotation is a model of
service.requests becomes the options of that model, and the function gets the model that was built from what was typed:

    def _solve(request: SolveRequest) -> None:
        from service.solve.solve import solve  # heavy imports stand inside commands

        with ProgressBar() as bar:
            result = solve(request, bar)
        print(f"maps     {result.maps_path}")

    local_command(app, "solve", _solve)

Where it does nothing else, `product_command` takes the model, the place of the product, and the function that prints its result.

Names, defaults and help are those of the model's fields; service.requests.base.options tells the rule, and the model checks the limits. The
help of the command is the function's docstring, or the model's where the function has none. Every other parameter of the function is an
option of the command alone, written for Typer in the usual way. A function that takes `Given[Model]` in place of the model gets what
was typed, to change or look at it before the model is built; several models share the options that they have in common.

To add a command: write its model in service/requests, its function here in service/cli, and register it. To add an option: write
the field. `relit submit` and the API follow for the work that they do, `relit farm template` for relight and shade, and the records of
results by the role of the field.
"""

import inspect
from collections.abc import Callable, Mapping
from enum import Enum
from functools import partial
from pathlib import Path
from pkgutil import resolve_name
from typing import Annotated, Any, Generic, Literal, get_args, get_origin

import typer
from pydantic import BeforeValidator, ValidationError

from service.cli.colours import OcioOption, colours
from service.cli.printing import print_warnings
from service.cli.progress import with_bar
from service.requests.base.base import Options, Role
from service.requests.base.options import Model, Option, build, help_text, is_document, options_of, require_outputs, typed, typed_name

ORDER = (Role.INPUT, Role.OUTPUT, Role.FILE, Role.CHOICE, Role.PART, Role.RUN, Role.MACHINE)
"""The order in which the help lists options."""
READ_BY_TYPER = (bool, int, float, Path, Enum)
"""The types that Typer reads; anything else is a text that the model parses."""


def _known(name: str | None) -> str | None:
    """Refuse a device that is not on this machine, also where the work is done on the CPU in any case."""
    if name is not None:
        from kernels.device import resolve

        resolve(name)
    return name


HostOption = Annotated[str | None, typer.Option(
    "--device", callback=_known, show_default=False,
    help="Taken by every command that works on images, so that scripts can use one device for all; this one always works on the CPU.")]


class Given(Generic[Model]):
    """The values that were typed for the options of a model, without those that were left out."""

    def __init__(self, model: type[Model], values: Mapping[str, Any]) -> None:
        self.model, self.values = model, dict(values)

    def build(self, **changes: Any) -> Model:
        """Make the model, with some values in place of those that were typed; errors name an option as it is typed."""
        try:
            return build(self.model, {**self.values, **changes})
        except ValidationError as error:
            from service.errors import RequestError, sentence  # which import what a request needs, and the start of the program does not

            raise RequestError(sentence(error, partial(typed_name, self.model))) from error


def local_command(group: typer.Typer, name: str, function: Callable[..., None]) -> None:
    """Add a command that works on this machine: where its request has no device, it takes --device all the same, and --ocio."""
    command(group, name, function, local=True)


def product_command(group: typer.Typer, name: str, model: type[Options], product: str, show: Callable[..., bool | None]) -> None:
    """Add a command that does the work of a product, a `module:function` that is loaded when it is called, and prints its result, and after
    that the result's warnings.
    `show`: prints the result, which it takes with, where it has two parameters, the request; where it returns False, the command ends with
    the exit code 1."""
    with_request = len(inspect.signature(show).parameters) > 1

    def run(request: model) -> None:  # type: ignore[valid-type]
        work = resolve_name(product)

        def in_one_stage(request: Options, progress: Any) -> Any:
            progress.stage(name, 1)
            return work(request)

        result = with_bar(work if "progress" in inspect.signature(work).parameters else in_one_stage, request)
        succeeded = show(result, request) if with_request else show(result)
        print_warnings(getattr(result, "warnings", ()))
        if succeeded is False:
            raise typer.Exit(1)

    local_command(group, name, run)


def command(group: typer.Typer, name: str, function: Callable[..., None], *, without: frozenset[Role] = frozenset(),
            local: bool = False, words: Callable[[Option, Any], str] = help_text) -> None:
    """Add a command that is made from a function, as the docstring of this module says.

    Args:
        without: roles of options that the command does not have.
        local: whether it takes --ocio, and --device also where no model asks for it.
        words: gives the help of an option of a model.
    """
    parameters = inspect.signature(function).parameters.values()
    models = {parameter.name: model for parameter in parameters if (model := _model(parameter.annotation)) is not None}
    lazy = {parameter.name for parameter in parameters if get_origin(parameter.annotation) is Given}
    own = [parameter.replace(kind=inspect.Parameter.KEYWORD_ONLY) for parameter in parameters if parameter.name not in models]

    def run(context: typer.Context, **values: Any) -> None:
        place = values.pop("ocio", None)
        was_typed = {name for name in values if (source := context.get_parameter_source(name)) and not source.name.startswith("DEFAULT")}
        arguments = {parameter.name: values[parameter.name] for parameter in own}
        with colours(place):
            for name, model in models.items():
                given = Given(model, {option.name: values[option.name] for option in options_of(model) if option.name in was_typed})
                arguments[name] = given if name in lazy else given.build()
                if local and name not in lazy:
                    require_outputs(arguments[name])
            function(**arguments)

    signature = [inspect.Parameter("context", inspect.Parameter.KEYWORD_ONLY, annotation=typer.Context),
                 *_parameters(list(models.values()), without, own, words)]
    if local:
        signature.append(inspect.Parameter("ocio", inspect.Parameter.KEYWORD_ONLY, annotation=OcioOption, default=None))
    if local and "device" not in {parameter.name for parameter in signature}:
        signature.append(inspect.Parameter("device", inspect.Parameter.KEYWORD_ONLY, annotation=HostOption, default=None))
    run.__signature__ = inspect.Signature(signature)  # type: ignore[attr-defined]
    run.__annotations__ = {parameter.name: parameter.annotation for parameter in signature}
    group.command(name, help=inspect.getdoc(function) or inspect.getdoc(next(iter(models.values()))) or "")(run)


def _model(annotation: Any) -> type[Options] | None:
    kind = get_args(annotation)[0] if get_origin(annotation) is Given else annotation
    return kind if isinstance(kind, type) and issubclass(kind, Options) else None


def _parameters(models: list[type[Options]], without: frozenset[Role], own: list[inspect.Parameter],
                words: Callable[[Option, Any], str]) -> list[inspect.Parameter]:
    """Return the options of all models and a command's own, in the order of the help."""
    found: dict[str, list[tuple[Option, type[Options]]]] = {}
    for model in models:
        for option in options_of(model):
            if option.role not in without:
                found.setdefault(option.name, []).append((option, model))
    places: list[tuple[tuple[bool, bool, int], inspect.Parameter]] = []
    for (option, model), *others in found.values():
        required = 1 + len(others) == len(models) and all(each.field.is_required() for each, _ in [(option, model), *others])
        place = (False, not required, 0) if option.spelling.argument else (True, not required, ORDER.index(option.role))
        places.append((place, _parameter(option, required, words(option, model))))
    places += [((True, parameter.default is not inspect.Parameter.empty, ORDER.index(Role.RUN)), parameter) for parameter in own]
    return [parameter for _, parameter in sorted(places, key=lambda entry: entry[0])]


def _parameter(option: Option, required: bool, about: str) -> inspect.Parameter:
    default = inspect.Parameter.empty if required else _default(option)
    kind = list[_typer_type(get_args(option.kind)[0])] if option.is_repeated else _typer_type(option.kind)  # type: ignore[misc]
    has_default = default not in (inspect.Parameter.empty, None)
    shown: dict[str, Any] = {"help": about, "metavar": option.spelling.metavar, "show_default": has_default}
    info: Any
    if option.spelling.argument:
        info = typer.Argument(**shown)
    elif kind is bool:
        info = typer.Option(f"{option.flag}/{option.off}" if option.field.default else option.flag, **shown)
    else:
        info = typer.Option(option.flag, **shown)
    annotation = Annotated[kind if default is not None else kind | None, info]  # type: ignore[valid-type]
    return inspect.Parameter(option.name, inspect.Parameter.KEYWORD_ONLY, annotation=annotation, default=default)


def _default(option: Option) -> Any:
    """Return the default of an option as the help shows it; None where nothing is shown."""
    default = option.field.default
    if option.field.is_required() or default in (None, "", ()):
        return None
    return typed(default) if isinstance(default, tuple) else default


def _typer_type(annotation: Any) -> Any:
    if get_origin(annotation) is Annotated:
        kind, *constraints = get_args(annotation)
        return str if any(isinstance(each, BeforeValidator) for each in constraints) else _typer_type(kind)
    if get_origin(annotation) is Literal:
        return annotation
    if is_document(annotation):
        return Path  # a JSON file that holds it
    return annotation if isinstance(annotation, type) and issubclass(annotation, READ_BY_TYPER) else str
