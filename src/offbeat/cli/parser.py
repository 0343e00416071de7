"""The parser of a command: its options are the arguments of a function.

Based on jsonargparse, with four additional rules. A boolean option is a flag, which may also be
given as `--flag=true` or `--flag=false`. A list may be given as `a,b,c`. The command line overrides
the config, in any order. No value can name a class or a function to call.
"""

from __future__ import annotations

import argparse
import difflib
import inspect
import itertools
import re
from argparse import ArgumentError
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import UnionType
from typing import Any, NamedTuple, NoReturn, NotRequired, Union, get_args, get_origin

import yaml
from jsonargparse import (  # type: ignore[attr-defined]  # it exports the first unseen
    ActionConfigFile,
    ArgumentParser,
    Namespace,
    get_loader,
    set_loader,
    set_parsing_settings,
)

from offbeat import safe_yaml
from offbeat.cli.help import Formatter, of_commands
from offbeat.config import ROWS_OR_SECONDS

set_parsing_settings(
    instantiate_subclass_spec_in_any=False,
    import_path_denylist=["*"],
    add_print_completion_argument=True,
)


_RENAMED = {
    "hide": "mask",
    "model.age_input": "model.time_input",
    "model.age_unit": "model.time_input_unit",
    "parts.hide": "split.mask",
    "parts.split": "split.by",
    "reader.held": "reader.repeated",
}
"""Options of 0.1.0, and what replaces them."""


class Option(NamedTuple):
    """An option without a default, which is in the mapping of its group only if given."""

    name: str
    type: Any
    help: str


class CommandParser(ArgumentParser):
    """The parser of one command.

    Args:
        function: the command; the first paragraph of its docstring is the description, the names
            under `Args:` are the options.
        groups: options of an argument that is a mapping, by the argument's name, made when they are
            needed.
        frequent: names of the options that `--help` shows; the rest is under `--help-all`. By
            default those that are in no group.
        **options: of `jsonargparse.ArgumentParser`.
    """

    def __init__(
        self,
        function: Callable[..., None] | None = None,
        groups: Mapping[str, Callable[[], Sequence[Option]]] | None = None,
        frequent: Sequence[str] | None = None,
        **options: Any,
    ) -> None:
        super().__init__(
            formatter_class=Formatter, exit_on_error=False, allow_abbrev=False, **options
        )
        self.function, self.groups_of, self.is_filled = function, groups or {}, False
        self.frequent = frequent

    def fill(self) -> None:
        """Adds the options of the function; called only for the command that runs."""
        if self.is_filled or self.function is None:
            return
        self.is_filled = True
        self.add_argument("--config", action=_Config, help="YAML file with options.")
        said = "print results and errors alone: no notes, warnings and progress bars."
        self.add_argument("--quiet", type=bool, default=False, help=said)
        said = "print more: times, the log of each step, and where an error comes from."
        self.add_argument("--verbose", type=bool, default=False, help=said)
        groups = self.groups_of.keys() & inspect.signature(self.function).parameters.keys()
        self.add_function_arguments(
            self.function, as_group=False, as_positional=True, sub_configs=True, skip=set(groups)
        )
        for name in sorted(groups):
            about = f"Options of the {name}."
            self.add_function_arguments(_function_of(self.groups_of[name](), about), name)
        actions: list[Any] = list(self._actions)
        for action in actions:
            kind = getattr(action, "_typehint", action.type)
            if kind in (bool, bool | None) and action.option_strings:
                self._make_flag(action)
            elif re.search(r"\b(list|tuple|Sequence)\[", str(kind)):
                if action.option_strings:
                    action.type = _Listed(kind)
                else:  # any number of them, as a shell passes them
                    action._typehint, action.nargs, action.metavar = kind.__args__[0], "+", None
            if action.dest in groups:
                action.help = "YAML file with the options of this group."
        paths = (action.dest for action in actions if not action.option_strings)
        self.usage = " ".join([self.prog, "[options]", *paths])

    def format_help(self, formatter: Any = None) -> str:
        """The help with the frequent options alone, in their order."""
        if self.function is None:
            return of_commands(self, str(super().format_help(formatter)))
        self.fill()
        actions = {a.option_strings[0].lstrip("-"): a for a in self._actions if a.option_strings}
        groups = {name.partition(".")[0] for name in actions if "." in name}
        names = self.frequent or [name for name in actions if "." not in name]
        last = ["help", "config", "quiet", "verbose"]
        others = {"h", "print_config", *groups, *last}
        names = [*(name for name in names if name not in others), *last]
        shown = [actions["h" if name == "help" else name] for name in names]
        formatter = formatter or self._get_formatter()
        formatter.add_usage(self.usage, self._actions, self._mutually_exclusive_groups)
        formatter.add_text(self.description)
        formatter.start_section("positional arguments")
        formatter.add_arguments([a for a in self._actions if not a.option_strings])
        formatter.end_section()
        formatter.start_section("options")
        formatter.add_arguments(shown)
        formatter.end_section()
        more = len(actions) - len(shown)
        if more > 1:
            formatter.add_text(f"{more} more options: {self.prog} --help-all")
        return str(formatter.format_help())

    def format_help_all(self) -> str:
        """The help with every option."""
        return str(super().format_help())

    def _make_flag(self, option: argparse.Action) -> None:
        """Allows an option of type bool without a value, or with true or false."""
        option.nargs = 0
        (name,) = option.option_strings
        self._option_string_actions[name] = _Flag([name], option.dest, nargs="?", const="true")
        for text in ("true", "false"):
            self._option_string_actions[f"{name}={text}"] = _Flag(
                [name], option.dest, nargs=0, const=text
            )

    def _match_argument(self, action: argparse.Action, pattern: str) -> int:
        """Number of the following strings that belong to an option; for a flag, true or false."""
        if isinstance(action, _Flag):
            following = self.args[len(self.args) - len(pattern) :][:1]
            return int(action.nargs == "?" and following in (["true"], ["false"]))
        return super()._match_argument(action, pattern)

    def parse_args(  # type: ignore[override]
        self, args: Any = None, namespace: Any = None, **options: Any
    ) -> Namespace:
        """Parses arguments; values of a config apply to options that are not given."""
        self.fill()
        if self.function is not None:
            if "--help-all" in args:
                print(self.format_help_all(), end="")
                self.exit()
            try:
                safe_yaml.check_value([text.partition("=")[2] or text for text in args])
            except yaml.YAMLError as error:
                raise ArgumentError(None, f"a value can't be read: {error}") from None
            self._refuse_pipes(args)
            first = argparse.ArgumentParser(add_help=False, allow_abbrev=False, exit_on_error=False)
            first.add_argument("--config", action="append", default=[])
            configs = first.parse_known_args(args)[0].config
            for config in configs:
                namespace = self._read(Path(config), namespace)
            self._drop_alternatives(args, namespace)
        try:
            return super().parse_args(args, namespace, **options)
        except ValueError as error:  # a value that names something to import
            raise ArgumentError(None, str(error)) from None

    def _drop_alternatives(self, args: Sequence[str], of_config: Namespace | None) -> None:
        """Removes from a config what the command line gives in another unit."""
        given = {text.partition("=")[0].lstrip("-") for text in args if text.startswith("--")}
        for pair in ROWS_OR_SECONDS:
            for name, other in (pair, pair[::-1]):
                replaced = f"split.{other}"
                now_given = f"split.{name}" in given and replaced not in given
                if now_given and of_config is not None and replaced in of_config:
                    del of_config[replaced]

    def _refuse_pipes(self, args: Sequence[str]) -> None:
        """Raises an error for a group of options whose file would never end."""
        groups = {f"--{name.lstrip('-').partition('.')[0]}" for name in self._option_string_actions
                  if "." in name}  # fmt: skip
        for text, following in itertools.zip_longest(args, args[1:], fillvalue=""):
            name, equals, value = text.partition("=")
            path = Path(value if equals else following)
            try:
                if name in groups and path.exists() and not path.is_file():
                    raise ArgumentError(
                        None, f"{name} {path} is no file, expected one with options"
                    )
            except (OSError, ValueError):
                continue  # a value that is no path

    def _read(self, path: Path, before: Namespace | None) -> Namespace:
        try:
            if path.exists() and not path.is_file():
                raise OSError("it is no file")
            with path.open(encoding="utf-8") as file:
                values = _load(file.read(safe_yaml.MOST_CHARACTERS + 1))
        except (OSError, UnicodeError, yaml.YAMLError) as error:
            raise ArgumentError(None, f"the config {path} can't be read: {error}") from None
        if not isinstance(values, dict):
            raise ArgumentError(None, f"the config {path} must contain options by name")
        values = {name: value for name, value in values.items() if value is not None}
        for action in self._actions:
            if action.nargs == "+" and not isinstance(values.get(action.dest, []), list):
                values[action.dest] = [values[action.dest]]
        try:
            read: Namespace = self.parse_object(
                values, before, defaults=False, _skip_validation=True, _skip_required=True
            )
        except (ArgumentError, ValueError) as error:
            raise ArgumentError(None, f"the config {path}: {error}") from None
        return read

    def get_completion_script(self, completion_type: str, **options: Any) -> str:
        """The script for a shell that completes commands, options and choices."""
        subcommands: Any = self._subcommands_action
        for command in subcommands._name_parser_map.values():
            command.fill()
        return super().get_completion_script(completion_type, **options)

    def error(self, message: str, ex: Exception | None = None) -> NoReturn:
        """Raises one line, with the nearest option where one is unknown."""
        unknown = re.search(r"unrecognized arguments: --([\w.]+)", message, re.IGNORECASE)
        unknown = unknown or re.search(r"does not accept option '([\w.]+)'", message)
        if unknown and "did you mean" not in message:
            within = re.search(r"Subcommand '(\w+)'", message)
            parser: Any = self
            if within and self._subcommands_action:
                parser = self._subcommands_action._name_parser_map[within[1]]
            known = [name for name in parser._option_string_actions if "=" not in name]
            new = _RENAMED.get(unknown[1], unknown[1])
            new = re.sub("^parts[.]", "split.", re.sub("^policies[.]", "options.", new))
            near = difflib.get_close_matches(f"--{new}", known, n=1, cutoff=0.7)
            message += f"; did you mean {near[0]!r}?" if near else ""
        elif re.search("unrecognized arguments: [^-]", message, re.IGNORECASE):
            message += "; give all paths together" if "together" not in message else ""
        message = message.replace(
            "ignored explicit argument", "takes no value, =true or =false, not"
        )
        super().error(message, ex)

    def spoken(self, message: str) -> str:
        """Translates a message of the library to the options of the command line.

        `window_s=0.5` becomes `--split.window_s 0.5`, and a name at the start of the message the
        option.
        """
        named: dict[str, set[str]] = {}
        for option in self._option_string_actions:
            if option.startswith("--") and not set("=+") & set(option):
                named.setdefault(option.lstrip("-").split(".")[-1], set()).add(option)
        start = r"(?<![\w.\-'\"|/])"
        for name, options in named.items():
            if len(options) > 1:
                continue
            (option,) = options
            message = re.sub(rf"{start}{name}='([\w.]+)'", rf"{option} \1", message)
            message = re.sub(rf"{start}{name}=(?=[\w'\"])", f"{option} ", message)
            message = re.sub(rf"{start}{name}=", option, message)
            alone = rf"{start}{name}(?![\w.='\"|/])" if "_" in name else f"^{name}(?= must)"
            message = re.sub(alone, option, message)
        return message


class _Config(ActionConfigFile):
    """Does nothing: the config is read before the other arguments."""

    def __call__(self, *_: Any) -> None:
        pass


class _Flag(argparse.Action):
    """Sets a boolean option."""

    def __call__(self, parser: Any, namespace: Any, values: Any, _: Any = None) -> None:
        setattr(namespace, self.dest, (values or self.const) == "true")


class _Listed:
    """Takes a list as `a,b,c`, or as YAML; a single name stays one where the option allows it."""

    def __init__(self, kind: Any) -> None:
        self.kind = kind
        union = get_origin(kind) in (Union, UnionType)
        self.or_text = union and str in get_args(kind)

    def __call__(self, text: str) -> Any:
        if self.or_text and "," not in text:
            return text
        return text if text[:1] in ("[", "{", '"') or text == "null" else text.split(",")

    def __repr__(self) -> str:
        return re.sub(r"\b[a-z_]+\.(?=\w)", "", str(self.kind)).replace("NoneType", "null")


def _function_of(options: Sequence[Option], about: str) -> Callable[..., None]:
    """Makes a function with these options as arguments without defaults."""

    def function() -> None:
        pass

    function.__doc__ = "\n".join(
        [about, "", "Args:", *(f"    {option.name}: {option.help}" for option in options)]
    )
    function.__signature__ = inspect.Signature(  # type: ignore[attr-defined]
        [
            inspect.Parameter(
                option.name, inspect.Parameter.KEYWORD_ONLY, annotation=NotRequired[option.type]
            )
            for option in options
        ]
    )
    return function


_load_yaml = get_loader("yaml")


def _load(text: str) -> Any:
    """Reads YAML as jsonargparse does, within the limits of `safe_yaml`."""
    safe_yaml.check(text)
    value = _load_yaml(text)
    if value != text:
        safe_yaml.check_value(value)
    return value


set_loader("yaml", _load, (yaml.YAMLError,))
