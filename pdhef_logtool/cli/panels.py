"""Help texts in panels: commands and options under the headings of their groups."""

from collections.abc import Iterable
from typing import Any

from typer.core import TyperCommand, TyperGroup

#: The groups of commands, in the order of the help; ``commands.toml`` has the group of each command.
_GLOBAL = frozenset({"--json", "--quiet", "-q", "--verbose", "--no-color"})
_PANELS = ("Look at logs", "Run and score", "Read results", "Learn", "Tools")


class PanelCommand(TyperCommand):
    """A command that lists its options by their ``rich_help_panel``."""

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Write the arguments, the options without a panel, then each panel."""
        records = [(_panel_of(p), p.get_help_record(ctx)) for p in self.get_params(ctx)]
        _write(formatter, records, "Options")


class CommandGroup(TyperGroup):
    """A group with panels and with commands of two words, for example ``simulate suite``."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Take the global options first; users may also write them at the end."""
        end = args.index("--") if "--" in args else len(args)
        first = [word for word in args[:end] if word in _GLOBAL]
        words = [*first, *(word for word in args[:end] if word not in _GLOBAL), *args[end:]]
        return super().parse_args(ctx, words)

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Write the global options, then the commands."""
        records = [("Options", p.get_help_record(ctx)) for p in self.get_params(ctx)]
        _write(formatter, records, "Options")
        self.format_commands(ctx, formatter)

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Write the commands by panel."""
        commands = [(name, c) for name in self.list_commands(ctx) if (c := self.get_command(ctx, name)) is not None]
        records = [(getattr(c, "rich_help_panel", ""), (name, c.get_short_help_str(200))) for name, c in commands]
        for panel in _PANELS:
            _write(formatter, [r for r in records if r[0] == panel], panel)

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """Use the first argument that is not an option as the second word of the command if such a command exists."""
        family = [c for name, c in self.commands.items() if name.split()[0] == args[0]]
        valued = {o for c in family for p in c.params if not getattr(p, "is_flag", False) for o in p.opts}
        words = (i for i in range(1, len(args)) if not args[i].startswith("-") and args[i - 1] not in valued)
        second = next(words, 0)
        if second and f"{args[0]} {args[second]}" in self.commands:
            args = [f"{args[0]} {args[second]}", *args[1:second], *args[second + 1 :]]
        return super().resolve_command(ctx, args)


def _panel_of(parameter: Any) -> str:
    if parameter.param_type_name == "argument":
        return "Arguments"
    return getattr(parameter, "rich_help_panel", None) or "Options"


def _write(formatter: Any, records: Iterable[tuple[str, tuple[str, str] | None]], first: str) -> None:
    """Write a section for each panel: arguments, ``first``, then the others in the order of their first record."""
    panels: dict[str, list[tuple[str, str]]] = {"Arguments": [], first: []}
    for panel, record in records:
        if record is not None:
            panels.setdefault(panel, []).append(record)
    for panel, rows in panels.items():
        if rows:
            with formatter.section(panel):
                formatter.write_dl(rows)
