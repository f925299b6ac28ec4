"""Write the generated parts of docs/reference: settings, commands and the Python API. `make docs-reference` runs this.

The parts are between `<!-- generated -->` and `<!-- end of generated -->`. Everything comes from the sources and the
parsers of the commands; nothing that an extra installs is imported.
"""

import argparse
import ast
import importlib
import inspect
import re
import sys
import textwrap
from collections.abc import Iterator
from pathlib import Path

from daedalus.cli.command_table import COMMANDS
from daedalus.cli.commands.settings_command import Setting, all_settings, sections

ROOT = Path(__file__).parents[1]
BEGIN, END = "<!-- generated -->", "<!-- end of generated -->"

# What the page of the Python API describes, as `module.name`, or by its name in `daedalus`.
PYTHON_API = {
    "Train": (
        *("train", "resume", "RunResult", "Callback", "TrainingRun", "TrainingError", "SettingsError", "read_metrics"),
        "RunDataError",
    ),
    "Use a trained policy": (
        *("evaluate", "EvaluationResult", "MatchScores", "MatchScore"),
        *("load_policy", "Policy", "Decisions", "NoPolicyError", "DamagedError"),
        *("EnvironmentSetupError", "ExportError", "HubError", "VideoError"),
    ),
    "Client": ("Client", "daedalus.actor.collecting.client_collector.ClientAgent"),
    "Transport": tuple(f"daedalus.transport.interface.{name}" for name in ("Transport", "Request", "Inbox")),
    "Metrics": tuple(f"daedalus.learner.reporting.metrics_rows.{name}" for name in ("MetricsWriter", "Details")),
}


def main() -> None:
    """Write the pages whose generated part differs, or only name them with --check."""
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("--check", action="store_true", help="write nothing; exit with 1 if a page differs")
    check, differing = options.parse_args().check, False
    for page, part in PAGES.items():
        path = ROOT / "docs" / "reference" / page
        before = path.read_text("utf-8")
        begin, rest = before.split(BEGIN)
        after = f"{begin}{BEGIN}\n\n{part().strip()}\n\n{END}{rest.partition(END)[2]}"
        if after != before:
            differing = True
            print(f"{page} differs from the code: run `make docs-reference`" if check else f"wrote {path}")
            if not check:
                path.write_text(after, "utf-8")
    if check and differing:
        raise SystemExit(1)


def settings_part() -> str:
    """Return a heading and a table for each section of a run's `config.toml`."""
    rows = list(all_settings())
    return "\n\n".join(
        "\n".join(
            [
                *(f"## {section}", "", textwrap.dedent(f"    {model.__doc__}").strip(), ""),
                *("| setting | type | range | default | meaning |", "|---|---|---|---|---|"),
                *(_setting_row(setting) for setting in rows if setting.section == section),
            ]
        )
        for section, model in sections().items()
    )


def _setting_row(setting: Setting) -> str:
    return _row(f"`{setting.path}`", setting.kind, setting.limits, setting.default, setting.meaning)


def _row(*cells: str) -> str:
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"


def commands_part() -> str:
    """Return a heading, the description, the arguments and the examples of each command and its verbs."""
    return "\n\n".join(section for command in COMMANDS.values() for section in _command(command.make_parser(), 2))


def _command(parser: argparse.ArgumentParser, level: int) -> Iterator[str]:
    # The text of --help is not the same in all releases of Python, so that this is made of the arguments themselves.
    yield f"{'#' * level} {parser.prog}"
    yield (parser.description or "").strip()
    shown = [action for action in parser._actions if action.help != argparse.SUPPRESS and action.dest != "help"]
    verbs = [action for action in shown if isinstance(action, argparse._SubParsersAction)]
    if rows := [_argument_row(parser, action) for action in shown if action not in verbs]:
        yield "\n".join(["| argument | meaning |", "|---|---|", *rows])
    if parser.epilog:
        yield f"```text\n{parser.epilog.strip()}\n```"
    for verb in (verb for action in verbs for verb in action.choices.values()):
        yield from _command(verb, level + 1)


def _argument_row(parser: argparse.ArgumentParser, action: argparse.Action) -> str:
    choices = "{" + ",".join(map(str, action.choices)) + "}" if action.choices is not None else None
    value = action.metavar or choices or action.dest.upper()
    words = " ".join(value) if isinstance(value, tuple) else value
    if action.option_strings:
        takes = action.nargs != 0
        name = " ".join([", ".join(action.option_strings), *([words] if takes else [])])
    else:
        name = {"?": f"[{words}]", "*": f"[{words} ...]", "+": f"{words} ..."}.get(str(action.nargs), words)
    required = "required: " if action.option_strings and action.required else ""
    meaning = required + (action.help or "") % {**vars(action), "prog": parser.prog}
    return _row(f"`{name}`", meaning.replace("*", "\\*"))


def python_part() -> str:
    """Return the signature and the docstring of each name of the public API, and of the public methods of classes."""
    parts = []
    for title, names in PYTHON_API.items():
        parts += [f"## {title}", *_INTRODUCTIONS.get(title, ()), *(part for name in names for part in _name(name))]
    return "\n\n".join(parts)


_INTRODUCTIONS = {
    "Client": ["The guide [Use your own loop](../guides/client.md) has an example."],
    "Transport": [
        "The interface between the services and the network. `daedalus.transport.zenoh_transport` implements it over\n"
        "Zenoh, `daedalus.transport.memory` within one process."
    ],
    "Metrics": ["The guide [Add a metrics writer](../guides/metrics_writer.md) has an example."],
}


def _name(name: str) -> Iterator[str]:
    """Yield the Markdown of one name."""
    module, _, bare = name.rpartition(".")
    defined = getattr(importlib.import_module(module or "daedalus"), bare)
    tree = ast.parse(inspect.getsource(sys.modules[defined.__module__]))
    found = [node for node in tree.body if getattr(node, "name", "") == bare]
    yield f"### {module or 'daedalus'}.{bare}"
    match found:
        case [ast.FunctionDef() as function]:
            yield _code(_signature(function))
            yield _prose(function)
        case [ast.ClassDef() as definition]:
            yield from _class(definition)


def _class(definition: ast.ClassDef) -> Iterator[str]:
    methods = [node for node in definition.body if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)]
    decorators = " ".join(ast.unparse(node) for node in definition.decorator_list)
    fields = [node for node in definition.body if isinstance(node, ast.AnnAssign)] if "dataclass" in decorators else []
    bases = f"({', '.join(map(ast.unparse, definition.bases))})" if definition.bases else ""
    yield _code("\n".join([f"class {definition.name}{bases}", *(f"    {ast.unparse(field)}" for field in fields)]))
    yield _prose(definition)
    yield from (_code(_signature(method, definition.name)) for method in methods if method.name == "__init__")
    for method in methods:
        if not method.name.startswith("_") and ast.get_docstring(method):
            yield f"#### {definition.name}.{method.name}"
            if not any(ast.unparse(node) in ("property", "cached_property") for node in method.decorator_list):
                yield _code(_signature(method))
            yield _prose(method)


def _signature(function: ast.FunctionDef | ast.AsyncFunctionDef, name: str = "") -> str:
    """Return a signature, one argument a line if it does not fit into one."""
    if function.args.args and function.args.args[0].arg in ("self", "cls"):
        function.args.args = function.args.args[1:]
    returns = f" -> {ast.unparse(function.returns)}" if function.returns is not None and not name else ""
    name = name or function.name
    one_line = f"{name}({ast.unparse(function.args)}){returns}"
    if len(one_line) <= 100:
        return one_line
    return f"{name}(\n{textwrap.indent(_argument_lines(function.args), '    ')}\n){returns}"


def _argument_lines(arguments: ast.arguments) -> str:
    lines = []
    positional = [*arguments.posonlyargs, *arguments.args]
    defaults = [None] * (len(positional) - len(arguments.defaults)) + list(arguments.defaults)
    for index, (argument, default) in enumerate(zip(positional, defaults, strict=True)):
        lines.append(_argument(argument, default))
        lines += ["/"] if index + 1 == len(arguments.posonlyargs) else []
    if arguments.vararg:
        lines.append(f"*{ast.unparse(arguments.vararg)}")
    elif arguments.kwonlyargs:
        lines.append("*")
    lines += [_argument(*each) for each in zip(arguments.kwonlyargs, arguments.kw_defaults, strict=True)]
    lines += [f"**{ast.unparse(arguments.kwarg)}"] if arguments.kwarg else []
    return ",\n".join(lines) + ","


def _argument(argument: ast.arg, default: ast.expr | None) -> str:
    equals = " = " if argument.annotation else "="
    return ast.unparse(argument) + (f"{equals}{ast.unparse(default)}" if default is not None else "")


def _prose(node: ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef) -> str:
    """Return a docstring as Markdown: the entries below `Args:` and the like become lists."""
    lines: list[str] = []
    in_list = False
    for line in (ast.get_docstring(node) or "").splitlines():
        entry = re.match(r"^  (?:  )?(\*{0,2}\w+(?:, \w+)*): (.*)$", line)
        if heading := re.fullmatch(r"(Args|Attributes|Raises|Returns|Yields)(.*):", line):
            title = {"Args": "Arguments"}.get(heading[1], heading[1])
            lines += [f"**{title}**{heading[2]}:", ""]
            in_list = True
        elif in_list and entry:
            lines.append(f"- `{entry[1]}`: {entry[2]}")
        else:
            in_list = in_list and line.startswith(" ")
            lines.append(f"  {line.strip()}" if in_list else line)
    return "\n".join(lines)


def _code(text: str) -> str:
    return f"```python\n{text}\n```"


PAGES = {"settings.md": settings_part, "commands.md": commands_part, "python.md": python_part}

if __name__ == "__main__":
    main()
