"""Objects from config sections: a section is bound to the signature of what takes it.

The signature says it all: which options there are, of which type and in which range (``Annotated``, see
:mod:`.ranges`), which of them have to be given. pydantic checks the values; an option whose type is a dataclass is a
section of its own and reaches the function as that object. Every complaint is one line with the option's full name, and
all of them come at once.

A section that picks a robot, planner or other thing says which by ``name``, see :mod:`sagemp_cli.plugins`. The resolved
config is stored in every artifact, so a section is untrusted input: it can pick names that are known, no more.
"""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, is_dataclass
from types import SimpleNamespace, UnionType
from typing import Annotated, Any, Literal, Union, cast, get_args, get_origin, get_type_hints

from pydantic import AfterValidator, AllowInfNan, BaseModel, ConfigDict, Field, Strict, ValidationError, create_model
from pydantic_core import PydanticUndefined

from sagemp_cli.config.memory import memory_limit
from sagemp_cli.config.ranges import OrInfinite
from sagemp_cli.config.wording import described
from sagemp_cli.errors import ConfigError, UsageError, did_you_mean
from sagemp_cli.plugins import KINDS
from sagemp_cli.plugins.registry import declared, resolve

_MOST_MEMORY = 2**30
"""Bytes that an object may take; those of this project take a few MB."""

NAME = "name"
"""The key that says which robot, planner, ... a section is about."""

_PLAIN = (int, float, str, bool, dict, list, tuple)


@dataclass(frozen=True)
class Binding:
    """A section of the config and what takes its options.

    Attributes:
        where: the section's dotted key.
        function: takes the options as keyword arguments.
        given: arguments of it that the stage gives, which the options may not set.
        beside: further options of the section that the stage itself reads, with their types.
    """

    where: str
    function: Callable[..., Any]
    given: tuple[str, ...] = ()
    beside: Mapping[str, Any] = field(default_factory=dict)

    def complaints(self, config: Mapping[str, Any]) -> list[str]:
        """Everything that is wrong with the section."""
        return option_complaints(self.function, self._section(config), self.where, given=self.given, beside=self.beside)

    def options(self, config: Mapping[str, Any]) -> dict[str, Any]:
        """The section as keyword arguments.

        Raises:
            ConfigError: one line with all complaints.
        """
        return options_for(self.function, self._section(config), self.where, given=self.given, beside=self.beside)

    def made(self, config: Mapping[str, Any], **extra: Any) -> Any:
        """What the function makes of the section and the arguments that the stage gives."""
        return self.function(**self.options(config), **extra)

    def _section(self, config: Mapping[str, Any]) -> Any:
        node: Any = config
        for part in self.where.split("."):
            node = node.get(part) if isinstance(node, Mapping) else None
        return node


def target_class(section: Any, where: str) -> Callable[..., Any]:
    """What a section's ``name`` stands for: a class, or of a planner also a function.

    Args:
        section: ``name`` and options.
        where: the section in messages; its first word says what kind of thing it picks.

    Raises:
        ConfigError: no such name.
    """
    return resolve(where.partition(".")[0], _name_in(section, where), where)


def attribute_of_target(section: Any, where: str, attribute: str, default: Any) -> Any:
    """A class attribute of the section's :func:`target_class`, see :func:`~sagemp_cli.plugins.registry.declared`."""
    return declared(where.partition(".")[0], _name_in(section, where), where, attribute, default)


def _name_in(section: Any, where: str) -> Any:
    if not isinstance(section, Mapping):
        raise ConfigError(f"{where} must be a section with a name, found {_short(section)}")
    if NAME not in section and "_target_" in section:
        raise ConfigError(
            f"{where}._target_ {_short(section['_target_'])}: made by an earlier version, which named classes by their "
            f"modules; make the file again, or write {where}.name"
        )
    return section.get(NAME)


def section_complaints(section: Any, where: str, given: Collection[str] | None = None) -> list[str]:
    """Everything that is wrong with a section that picks something by name.

    Args:
        section: ``name`` and options.
        where: the section in messages.
        given: arguments that the stages give; by default those of the kind.
    """
    try:
        function = target_class(section, where)
    except UsageError as e:
        return [str(e)]
    return option_complaints(function, _options_in(section), where, given=_given(where) if given is None else given)


def option_complaints(
    function: Callable[..., Any],
    options: Any,
    where: str,
    *,
    given: Collection[str] = (),
    beside: Mapping[str, Any] | None = None,
) -> list[str]:
    """Everything that is wrong with options as keyword arguments of a function or class.

    Args:
        function: what takes the options.
        options: mapping of the config; None stands for no options.
        where: the section in messages; may be empty.
        given: arguments that are given otherwise, which the options may not set.
        beside: further options with their types.
    """
    return _bound(function, options, where, given, beside)[1]


def options_for(
    function: Callable[..., Any],
    options: Any,
    where: str,
    *,
    given: Collection[str] = (),
    beside: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """Options as keyword arguments of a function or class that takes them all: none is silently ignored.

    Raises:
        ConfigError: one line with all :func:`option_complaints`, whose arguments these are.
    """
    bound, wrong = _bound(function, options, where, given, beside)
    if wrong:
        raise ConfigError("; ".join(wrong))
    return bound


def build(section: Any, where: str, **extra: Any) -> Any:
    """Build the object that a config section describes; of a function, the function with these options.

    Args:
        section: ``name`` and options.
        where: the section in messages.
        extra: further keyword arguments that come from data, not from the config.

    Raises:
        ConfigError: one line with everything that is wrong.
    """
    function = target_class(section, where)
    later = () if inspect.isclass(function) else KINDS[where.partition(".")[0]].called_with
    options = options_for(function, _options_in(section), where, given=(*extra, *later))
    if not inspect.isclass(function):
        return functools.partial(function, **options, **extra)
    try:
        with memory_limit(_MOST_MEMORY):
            return function(**options, **extra)
    except (TypeError, ValueError, ArithmeticError, MemoryError, RuntimeError) as e:
        first = next((line for line in str(e).splitlines() if line.strip()), type(e).__name__).strip()
        if "memory" in first or isinstance(e, MemoryError):
            first = f"needs more than {_MOST_MEMORY >> 20} MiB of memory; its sizes must be smaller"
        raise ConfigError(f"{where}: {first}") from e


def parameters_of(function: Callable[..., Any]) -> dict[str, tuple[inspect.Parameter, Callable[..., Any]]]:
    """The parameters of a function or of a class's constructor by name, each with the function that declares it.

    A constructor that takes ``**others`` hands them to its base class, so those of the base class are parameters too.
    """
    if not inspect.isclass(function):
        return {name: (p, function) for name, p in inspect.signature(function).parameters.items()}
    found: dict[str, tuple[inspect.Parameter, Callable[..., Any]]] = {}
    for constructor in (cls.__init__ for cls in function.__mro__[:-1] if "__init__" in vars(cls)):
        _, *own = inspect.signature(constructor).parameters.values()
        named = {p.name: (p, constructor) for p in own if p.kind not in (p.VAR_POSITIONAL, p.VAR_KEYWORD)}
        if is_dataclass(function):  # each field's type is a name in the module of the class that declares it
            named = {name: (p, _declaring(function, name)) for name, (p, _) in named.items()}
        found = named | found
        if not any(p.kind is p.VAR_KEYWORD for p in own):
            break
    return found


def _declaring(function: type, field: str) -> Callable[..., Any]:
    """The constructor of the dataclass that declares a field, or redeclares it last."""
    return next(cls.__init__ for cls in function.__mro__ if field in vars(cls).get("__annotations__", {}))


def _options_in(section: Mapping[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in section.items() if key != NAME}


def _given(where: str) -> tuple[str, ...]:
    kind = KINDS[where.partition(".")[0]]
    return (*kind.from_data, *kind.called_with)


def _bound(
    function: Callable[..., Any],
    options: Any,
    where: str,
    given: Collection[str],
    beside: Mapping[str, Any] | None,
) -> tuple[dict[str, Any], list[str]]:
    """Options as keyword arguments, and what is wrong with them."""
    options = {} if options is None else options
    if not isinstance(options, Mapping):
        return {}, [f"{where} must be a section, found {_short(options)}"]
    hints = {name: _hint(*p) for name, p in parameters_of(function).items() if name not in given} | dict(beside or {})
    options, wrong = _things_built({str(key): value for key, value in options.items()}, hints, where)
    model = _model(function, frozenset(given), tuple((beside or {}).items()))
    try:
        checked = model.model_validate(options)
    except ValidationError as e:
        return {}, wrong + list(dict.fromkeys(_sentences(e, model, options, where)))
    bound = _keywords(checked)
    if is_dataclass(function) and not given and not wrong:  # what it says itself, of several options together
        try:
            cast("Callable[..., Any]", function)(**bound)
        except UsageError as e:
            wrong.append(str(e) if str(e).startswith(where) else f"{where}: {e}")
    return bound, wrong


def _things_built(options: dict[str, Any], hints: Mapping[str, Any], where: str) -> tuple[dict[str, Any], list[str]]:
    """Options that are sections with a name of their own, where an object is wanted, replaced by the object."""
    wrong: list[str] = []
    for key, value in options.items():
        hint = hints.get(key)
        if not inspect.isclass(hint) or hint in (Any, *_PLAIN) or is_dataclass(hint):
            continue
        try:
            built = build(value, f"{where}.{key}")
        except UsageError as e:
            wrong.append(str(e))
            continue
        if not isinstance(built, hint):
            wrong.append(f"{where}.{key} must be a {hint.__name__}, found {type(built).__name__}")
        options = options | {key: built}
    return options, wrong


@functools.cache
def _model(
    function: Callable[..., Any], given: frozenset[str] = frozenset(), beside: tuple[tuple[str, Any], ...] = ()
) -> type[BaseModel]:
    """The options of a function as a pydantic model; a field's name is its number, its alias the option's name."""
    fields: dict[str, Any] = {}
    wanted = [(name, _hint(*p), p[0].default) for name, p in parameters_of(function).items() if name not in given]
    empty = inspect.Parameter.empty
    for i, (name, hint, default) in enumerate([*wanted, *((n, h, empty) for n, h in beside)]):
        missing = PydanticUndefined if default is empty else None
        fields[f"f{i}"] = (Annotated[_checked(hint), Field(alias=name, title=described(hint))], missing)
    config = ConfigDict(extra="forbid", arbitrary_types_allowed=True, protected_namespaces=())
    return create_model(getattr(function, "__name__", type(function).__name__), __config__=config, **fields)


def _keywords(checked: BaseModel) -> dict[str, Any]:
    """What was given, by the options' names."""
    fields = type(checked).model_fields
    return {str(fields[name].alias): getattr(checked, name) for name in fields if name in checked.model_fields_set}


def _checked(hint: Any) -> Any:
    """The hint as pydantic is to check plain data: nothing is converted, numbers are finite, dataclasses are built."""
    origin, inner = get_origin(hint), get_args(hint)
    if origin is Annotated:
        endless = any(isinstance(m, OrInfinite) for m in inner[1:])
        return Annotated[(Annotated[float, Strict()] if endless else _checked(inner[0]), *inner[1:])]
    if origin in (Union, UnionType):
        return Union[tuple(_checked(h) for h in inner)]  # noqa: UP007
    if origin in (list, tuple, Sequence):
        return list[_checked(inner[0]) if inner else Any]
    if origin is Mapping:
        return dict[str, Any]
    if hint is float:
        return Annotated[float, Strict(), AllowInfNan(False)]
    if hint in (int, str, bool):
        return Annotated[hint, Strict()]
    if inspect.isclass(hint) and is_dataclass(hint):
        return Annotated[_model(hint), AfterValidator(functools.partial(_as_object, hint))]
    return hint if origin is not None or hint in (type(None), dict) else Any


def _as_object(cls: type, checked: BaseModel) -> Any:
    try:
        return cls(**_keywords(checked))
    except UsageError as e:
        raise ValueError(str(e)) from e


def _sentences(error: ValidationError, model: type[BaseModel], options: Any, where: str) -> Iterator[str]:
    """pydantic's findings in our words; missing options of a section together."""
    missing: dict[tuple[str, str], list[str]] = {}
    for found in error.errors(include_url=False):
        section, here, value, keys = model, where, options, [str(key) for key in found["loc"]]
        while True:
            key, fields = keys.pop(0) if keys else "", {str(f.alias): f for f in section.model_fields.values()}
            inner = _section_in(fields[key].annotation) if key in fields else None
            value = value.get(key) if isinstance(value, Mapping) else value
            if inner is None or not keys:
                break
            section, here = inner, _dotted(here, key)
        full = _dotted(here, key)
        # What only holds a section's options is not worth a word; what is built or called with them is.
        name = "" if section.__name__.endswith("Options") else section.__name__
        if found["type"] == "missing":
            missing.setdefault((here, name), []).append(key)
        elif found["type"] == "extra_forbidden":
            near = did_you_mean(key, fields) or f"; known: {', '.join(fields) or 'none'}"
            yield f"{full}: {name} has no such option{near}" if name else f"{full}: no such option{near}"
        elif found["type"] == "value_error":
            yield str(found.get("ctx", {})["error"])
        elif inner is not None:
            yield f"{full} must be a section, found {_short(value)}; its keys: {', '.join(_options_of(inner))}"
        else:
            near = did_you_mean(value, _choices(fields[key].annotation)) if isinstance(value, str) else ""
            yield f"{full} must be {fields[key].title}, found {_short(value)}{near}"
    for (here, name), keys in missing.items():
        yield f"{here}: {name} needs {', '.join(keys)}" if name else f"{here or 'the config'} needs {', '.join(keys)}"


def _section_in(annotation: Any) -> type[BaseModel] | None:
    """The model that a field's annotation is made of, itself or beside None."""
    if get_origin(annotation) is Annotated:
        return _section_in(get_args(annotation)[0])
    if get_origin(annotation) in (Union, UnionType):
        return next((m for m in map(_section_in, get_args(annotation)) if m is not None), None)
    return annotation if inspect.isclass(annotation) and issubclass(annotation, BaseModel) else None


def _choices(annotation: Any) -> list[str]:
    """The words of a ``Literal``."""
    return [str(word) for word in get_args(annotation)] if get_origin(annotation) is Literal else []


def _options_of(model: type[BaseModel]) -> list[str]:
    return [str(f.alias) for f in model.model_fields.values()]


def _dotted(where: str, key: str) -> str:
    return f"{where}.{key}" if where and key else where or key


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 120 else f"{text[:117]}..."


def _hint(parameter: inspect.Parameter, declared: Callable[..., Any]) -> Any:
    """The type that a parameter's annotation names; Any if it is a name that exists for type checkers only."""
    if parameter.annotation is inspect.Parameter.empty:
        return Any
    holder = SimpleNamespace(__annotations__={"it": parameter.annotation})
    names = getattr(inspect.unwrap(declared), "__globals__", {})
    try:
        return get_type_hints(holder, globalns=names, include_extras=True)["it"]
    except NameError:
        return Any
