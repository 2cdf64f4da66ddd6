"""Commands, their arguments and options, from what ``--help`` says of them; refusals from their codes."""

from __future__ import annotations

import ast
import inspect
from collections.abc import Iterator

import typer.main
from typer.core import TyperArgument, TyperCommand, TyperGroup, TyperOption

from docs.generate.declared import documented, plain, table
from zbridge import errors
from zbridge.cli.app import app
from zbridge.doctor.robot import REMEDIES
from zbridge.errors import Code, Refused

BUS = ("--connect", "--realm", "--tls")
"""Options of every command that joins the bus; ``zbridge ls`` has all of them, and their help."""


def commands(group: TyperGroup, path: str = "zbridge") -> Iterator[tuple[str, TyperCommand | TyperGroup]]:
    """Give every command with its name, in the order of the help; a group too, if it does something by itself."""
    for name in group.list_commands(typer.Context(group)):
        command = group.commands[name]
        if isinstance(command, TyperGroup):
            if command.invoke_without_command:
                yield f"{path} {name}", command
            yield from commands(command, f"{path} {name}")
        elif isinstance(command, TyperCommand) and not command.hidden:
            yield f"{path} {name}", command


def one(name: str, command: TyperCommand | TyperGroup, shared: set[str]) -> str:
    """Write one command. shared: the helps of the options of the bus."""
    pieces = command.collect_usage_pieces(typer.Context(command, info_name=name))
    usage = " ".join([name, *pieces]).replace("{", "").replace("}", "")
    rows, joins = [], []
    for parameter in command.params:
        if isinstance(parameter, TyperArgument):
            argument = (parameter.metavar or parameter.name or "").strip("[].").upper()
            rows.append((f"`{argument}`", shown(parameter), plain(parameter.help or "")))
        elif isinstance(parameter, TyperOption) and not parameter.hidden and "--help" not in parameter.opts:
            if parameter.help in shared:
                joins.append(f"`{parameter.opts[0]}`")
            else:
                names = ", ".join(f"`{name}`" for name in parameter.opts)
                rows.append((names, shown(parameter), plain(parameter.help or "")))
    parts = [f"### {name}", plain(command.help or ""), f"```text\n{usage}\n```"]
    parts += [table(("argument or option", "default", "meaning"), rows)] if rows else []
    parts += [f"And the [options of the bus](#options-of-the-bus): {', '.join(sorted(joins))}."] if joins else []
    return "\n\n".join(parts) + "\n"


def shown(parameter: TyperArgument | TyperOption) -> str:
    """Write a default that tells something."""
    default = parameter.default
    if getattr(parameter, "is_flag", False) or callable(default) or default in (None, "", [], ()):
        return "required" if parameter.required else "-"
    return f"`{default}`"


def bus_options(group: TyperGroup) -> list[TyperOption]:
    """Return the options of the bus, as ``zbridge ls`` has them."""
    options = [parameter for parameter in group.commands["ls"].params if isinstance(parameter, TyperOption)]
    return [option for option in options if option.opts[0] in BUS]


def refusals() -> str:
    """Write every code with the class that Python raises, what it means and what to do."""
    families = {code: family for family in Refused.__subclasses__() for code in family.codes}
    (body,) = (node.body for node in ast.parse(inspect.getsource(errors)).body if getattr(node, "name", "") == "Code")
    told = documented(body)
    rows = ((f"`{code}`", f"`{families[code].__name__}`", told[code.name].rstrip("."), REMEDIES[code]) for code in Code)
    return table(("code", "class of `zbridge.errors`", "when", "what to do"), rows)


def sections() -> dict[str, str]:
    """Return every generated part of the pages by its name."""
    group = typer.main.get_group(app)
    assert isinstance(group, TyperGroup)
    bus = bus_options(group)
    variables = (f"`{each.envvar}`" if each.envvar else "-" for each in bus)
    rows = [(f"`{each.opts[0]}`", name, plain(each.help or "")) for each, name in zip(bus, variables, strict=True)]
    shared = {option.help or "" for option in bus}
    return {
        "bus options": table(("option", "variable", "meaning"), rows),
        "commands": "\n".join(one(name, command, shared) for name, command in commands(group)),
        "refusals": refusals(),
    }
