"""Commands that say what there is to choose, begin a part of one's own, and show what is kept: `quadexp options`,
`new`, `cache`. Only light modules are imported at the top."""

from __future__ import annotations

import keyword
import re
import shlex
from pathlib import Path
from typing import Annotated, NamedTuple

from quadexp.cli.command import Answer, Ask, Conf, command
from quadexp.errors import UsageError
from quadexp.plugin import shipped_places
from quadexp.writer import check_output, write_text

HEADING = "Extend"


@command
def options(
    asked: Annotated[
        str, Ask("A group, an option, or a word to look for.", "[GROUP | GROUP=OPTION | WORD]", word=True)
    ] = "",
    conf: Conf = (),
) -> Answer:
    """List groups, options, and the keys of an option with value, range, unit and meaning.

    \b
    quadexp options
    quadexp options wind
    quadexp options wind=gust
    quadexp options latency
    """
    from quadexp.parts.listing import listed

    records = listed(asked, conf)
    first = max((len(next(iter(record.values()))) for record in records), default=0)
    lines = []
    for record in records:
        name, *rest = record.values()
        if "key" in record:
            rest = [f"{record['value']:12s}", f"{record['allowed']:18s}", record["meaning"]]
        lines.append("  ".join([f"{name:{min(first, 34)}s}", *rest]).rstrip())
    return Answer({"asked": asked, "found": records}, records, lines)


@command
def cache(clear: Annotated[bool, Ask("Remove all of it; it is made again when needed.")] = False) -> Answer:
    """Show, or clear, the folder of compiled functions.

    It is QUADEXP_CACHE, or else the user's cache folder. Compiled functions that were not used for longest go first.

    \b
    quadexp cache
    quadexp cache --clear
    """
    from quadexp import cache as kept

    folder = kept.cache_folder()
    if clear:
        kept.clear(folder)
    sizes = [about.st_size for about in kept.libraries(folder).values()]
    record = {"folder": folder, "libraries": len(sizes), "bytes": sum(sizes), "bound": kept.BOUND}
    full = f"{sum(sizes) / 1e6:.1f} of at most {kept.BOUND / 1e6:.0f} MB"
    return Answer(record, [record], [f"{len(sizes)} compiled functions, {full}", folder])


NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]*", re.ASCII)
WORDS = {"null", "true", "false", "yes", "no", "on", "off", "inf", "nan", "conftest"}  # of YAML, overrides and pytest


class Template(NamedTuple):
    """The example that a new part is copied from. example: its name. option: configuration group and name of what is
    flown, with NAME for the example's. module: whether there is a Python file. words: the example's class name. model:
    whether it is fitted first, as an option of the group `model`."""

    example: str
    option: str
    module: bool = True
    words: str = ""
    model: bool = False

    def named(self, name: str) -> tuple[str, str]:
        """Group and option of what is flown."""
        group, _, option = self.option.partition("/")
        return group, option.replace("NAME", name)


TEMPLATES = {
    "vehicle": Template("quad_x", "vehicle/NAME", module=False),
    "trajectory": Template("helix", "trajectory/NAME", words="Helix"),
    "plant": Template("motor_lag", "plant/NAME", words="MotorLag"),
    "model": Template("cubic_drag", "controller/NAME_mpc", words="CubicDrag", model=True),
    "controller": Template("geometric", "controller/NAME", words="Geometric"),
}
for _part, _words in shipped_places("templates").items():
    _example, _option, _class = _words.split()
    TEMPLATES[_part] = Template(_example, _option, words=_class)
FORMER = {"residual": "model"}  # words of the release before
NewPart = Annotated[str, Ask(f"What to begin: {', '.join(TEMPLATES)}.", "PART")]
NewName = Annotated[str, Ask("Name of module, option and test: a Python identifier.", "NAME")]
To = Annotated[Path, Ask("A configuration folder, given to other commands by --conf.", "DIR")]


@command
def new(part: NewPart, name: NewName, to: To = Path("my_parts")) -> Answer:
    """Begin a part of your own: a module, its option, and a test that passes, to be changed step by step.

    \b
    quadexp new trajectory spiral --to my_parts
    quadexp new model flapping
    """
    notes = [f"new {part}: is `new {FORMER[part]}` now"] if part in FORMER else []
    part = FORMER.get(part, part)
    if part not in TEMPLATES:
        raise UsageError(f"new {part}: must be one of {', '.join(TEMPLATES)}")
    template = TEMPLATES[part]
    texts = _texts(template, name)
    group, option = template.named(name)
    check_name(part, name, template, to)
    for path in texts:
        if (to / path).exists():
            raise UsageError(f"new {part}: {to / path} exists already: choose another name, or another --to")
        check_output(to / path)
    for path, text in texts.items():
        write_text(to / path, text, force=False)
    files = [to / path for path in texts]
    folder = shlex.quote(str(to))
    commands = [f"python -m pytest {shlex.quote(str(files[-1]))}"]
    if template.model:
        commands.append(f"quadexp fit {name} data/residuals.parquet --conf {folder} --out models/{name}")
    commands.append(f"quadexp simulate --conf {folder} {group}={option} --out runs/{option}.parquet")
    record = {"part": part, "name": name, "option": f"{group}={option}", "files": files, "commands": commands}
    hints = ["", "test it, fly it, then make it yours:", *(f"    {words}" for words in commands)]
    return Answer(record, [{"file": str(file)} for file in files], [*files, *hints], notes)


def examples_folder() -> Path:
    """The folder of examples: in the package when installed, beside it in a checkout."""
    package = Path(__file__).resolve().parent.parent
    for folder in (package / "examples", package.parent / "examples"):
        if (folder / "helix.py").is_file():
            return folder
    raise UsageError(f"no examples beside {package}: the installation is incomplete")


def _texts(template: Template, name: str) -> dict[str, str]:
    """File -> text: the example's files with its names replaced; the test comes last."""
    old = template.example
    files = [f"{old}.py"] if template.module else []
    files += [f"model/{old}.yaml"] if template.model else []
    files += ["/".join(template.named(old)) + ".yaml", f"test_{old}.py"]
    names = {old: name}
    if template.words:
        names[template.words] = "".join(word[:1].upper() + word[1:] for word in name.split("_"))

    def renamed(text: str) -> str:
        return re.sub("|".join(names), lambda match: names[match[0]], text)

    folder = examples_folder()
    return {renamed(file): renamed((folder / file).read_text(encoding="utf-8")) for file in files}


def check_name(part: str, name: str, template: Template, to: Path) -> None:
    """Raise UsageError where the name cannot be one of a module, of an option and of a test, or is taken."""
    from importlib.util import find_spec

    from quadexp.parts.models import is_shipped
    from quadexp.parts.options import groups

    if not NAME.fullmatch(name) or keyword.iskeyword(name) or keyword.issoftkeyword(name):
        raise UsageError(f"new {part}: {name!r} is not a valid name of a module: a letter, then letters, digits or _")
    if name.lower() in WORDS:
        raise UsageError(f"new {part}: {name!r} means something else in YAML, on the command line or to pytest")
    group, option = template.named(name)
    for where, there in ((group, option), *([("model", name)] if template.model else [])):
        if there in groups().get(where, ()):
            raise UsageError(f"new {part}: there is {where}={there} already: choose another name")
    if template.model and is_shipped(name):
        raise UsageError(f"new {part}: quadexp/models has a module {name}: choose another name")
    if not template.module:
        return
    if find_spec(name) is not None and not (to / f"{name}.py").exists():
        raise UsageError(f"new {part}: a Python module {name} exists, and would be used instead: choose another")
    code = (examples_folder() / f"{template.example}.py").read_text(encoding="utf-8")
    if name in re.findall(r"\b[A-Za-z_]\w*", code) and name != template.example:
        raise UsageError(f"new {part}: {name!r} is used in the code that is written: choose another name")
