"""From overrides to a configuration.

Hydra (hydra_files.py) lends its composition of files and its override grammar (comma lists, range, choice, glob). It
composes a choice of options once, and what it made is kept between runs (kept.py); an option that nothing else speaks
of is composed alone and put in place, so that a sweep over many combinations composes every option once. Values are
then set in plain dictionaries, and a node is made, and so checked, once for every set of values. Configurations share
their nodes: these cannot be changed.
"""

from __future__ import annotations

import contextlib
import copy
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

from quadexp.config.cells import Cell as Cell
from quadexp.config.cells import Cells, Grid, refuse_mistakes
from quadexp.config.completion import folders, groups
from quadexp.config.kept import KeptCompositions
from quadexp.config.override import Given, plain_override, quoted
from quadexp.config.plugins import import_from
from quadexp.config.schema import BUNDLES, PRESETS, SCHEMA, SCHEMAS, WORLD, Config, world_name
from quadexp.config.settings import declared, made, plain
from quadexp.errors import UsageError
from quadexp.messages import MOST_NAMED, ending_in, one_line, suggestion

_INTEGER = re.compile(r"0|-?[1-9]\d{0,17}")
_REFERENCE = re.compile(r"\$\{(\w+(?=\})|)")
_WHOLE_REFERENCE = re.compile(r"\$\{(\w+)\}")
# Keys that hold a path.
PATHS = {
    "model", "plant.model", "trajectory.path", "wind.path", "collect.identified", "engine.shared", "engine.python",
    "engine.remote_python", "engine.tls_ca", "engine.tls_cert", "engine.tls_key",
}  # fmt: skip
HYDRA = {  # how a key of Hydra itself begins -> what does that here
    "hydra.sweep.": "--out names the folder of a sweep",
    "hydra.run.": "--out names where a flight is written",
    "hydra.job.": "--out names what is written",
    "hydra/launcher": "engine=local, dask or slurm says where a sweep is flown",
    "hydra.launcher": "engine=local, dask or slurm says where a sweep is flown, evaluate.workers on how many processes",
    "hydra/sweeper": "evaluate --sweep flies every combination",
    "hydra.sweeper": "evaluate --sweep flies every combination",
    "hydra.searchpath": "--conf names a folder of configuration",
    "hydra": "Hydra composes the configuration, and nothing else",
}
EACH = "each"  # of a grid under an experiment's `sweep:`, see _written_out
KEPT = 50_000  # parsed overrides, and made nodes, that are remembered at most


class Node(NamedTuple):
    """A node before its values are set, or a value of the root. source: what it was composed from."""

    source: tuple[str, ...]
    content: Any
    schema: type | None
    references: tuple[str, ...]


class Composer:
    """Composes configurations from conf/ and a user's own folder (extra); use `session`."""

    def __init__(self, extra: Path | None = None) -> None:
        self._folders = folders(extra)
        self._options = groups(extra)
        self._kept = KeptCompositions(self._folders)
        self._wholes: dict[tuple[str, ...], dict[str, Node]] = {}
        self._together: dict[tuple[str, ...], dict[str, Node]] = {}
        self._alone: dict[str, dict[str, Node]] = {}
        self._made: dict[tuple[Any, ...], Any] = {}
        self._parsed: dict[str, Given] = {}
        self._checked: set[tuple[Any, ...]] = set()

    def compose(self, overrides: Sequence[str] = ()) -> Config:
        """The configuration of one run.

        Raises UsageError with one line: unknown key or option, value of a wrong type or out of range, value missing,
        several values for one key.
        """
        with _one_line():
            return self._compose(self._parse(overrides))

    def expand(self, overrides: Sequence[str] = (), *, check: bool = True) -> Cells:
        """Every combination of a sweep: the values on the command line, over those of the experiment's `sweep:`.

        check: compose all of them before any is returned, see `refuse_mistakes`. They are composed again when they are
        asked for, and a sweep asks for all before it flies the first, so it need not.
        """
        with _one_line():
            parsed = self._parse(overrides, sweep=True)
            cells = Cells([_product(grid) for grid in self._grids(parsed)], self._cell_config)
            for _ in refuse_mistakes(cells) if check else ():
                pass
        return cells

    def options(self, group: str) -> list[str]:
        """Names of a group's options."""
        return [name for name in self._options.get(group, ()) if not name.startswith("_")]

    def having(self, key: str) -> dict[str, list[str]]:
        """Dotted keys that are the given one or end in it -> the options, chosen or not, that have it."""
        found: dict[str, list[str]] = {}
        for group, schemas in SCHEMAS.items():
            named = {f"{group}.{name}" for schema in schemas.values() for name in declared(schema)}
            for name in ending_in(key, sorted(named)) + ([key] if key in named else []):
                kinds = {kind for kind, schema in schemas.items() if name.removeprefix(f"{group}.") in declared(schema)}
                options = [f"{group}={one}" for one in self.options(group) if self._schema_of(group, one) in kinds]
                found |= {name: options[:MOST_NAMED]} if options else {}
        return found

    def _schema_of(self, group: str, option: str) -> str:
        """The schema that an option's file names, "" where it names none itself."""
        for file in (folder / group / f"{option}.yaml" for folder in self._folders):
            if file.is_file():
                named = re.search(rf"/schema/{group}/(\w+)@", file.read_text(encoding="utf-8", errors="replace"))
                return named[1] if named else ""
        return ""

    # ------------------------------------------------------------------------------------------------ configurations
    def _cell_config(self, overrides: Sequence[str]) -> Config:
        with _one_line():
            config = self._compose(self._parse(overrides), parts=True)
        return config if config.sweep is None else replace(config, sweep=None)  # a cell is one flight

    def _grids(self, parsed: list[Given]) -> Iterator[list[Given]]:
        """The overrides of every grid: one, or one for each mapping under `sweep:` of the experiments."""
        experiments = [one for one in parsed if one.key == "experiment"]
        if not experiments:
            yield parsed
            return
        given = {one.key for one in parsed}
        chosen = experiments[-1]
        values = [chosen.text.partition("=")[2]] if chosen.sweep is None else chosen.sweep
        rest = [one for one in parsed if one.key != "experiment"]
        for value in values:
            choice = self._parse([f"experiment={value}"])
            sweep = self._compose(choice, parts=True).sweep
            for grid in _written_out(sweep or {}, str(value)):
                # The mapping's order is kept: what stands first varies slowest.
                own = [f"{key}={_as_override(text)}" for key, text in grid.items() if key not in given]
                yield choice + self._parse(own, sweep=True) + rest

    def _compose(self, parsed: Sequence[Given], *, parts: bool = False) -> Config:
        """parts: compose options one by one, for many configurations with few options."""
        chosen = [one for one in parsed if one.key in self._options]
        values = [one for one in parsed if one.key not in self._options]
        key = tuple(one.text for one in chosen)
        base = self._put_together(chosen, key) if parts else self._whole(chosen)
        for one in values:
            if (key, one.key) not in self._checked:
                _check_key({name: node.content for name, node in base.items()}, one.key, self.having)
                self._checked.add((key, one.key))
            if one.key in base and base[one.key].schema is not None and not isinstance(one.value, Mapping):
                first = next(iter(base[one.key].content))
                raise UsageError(f"{one.text}: holds keys; set one of them, such as {one.key}.{first}=...")
        config = Config(**self._nodes(base, values))
        config = replace(config, world=self._world_name(config, chosen, values))
        baseline = config.evaluate.baseline
        if baseline not in self._options["controller"]:
            hint = suggestion(baseline, self.options("controller"))
            raise UsageError(f"evaluate.baseline={baseline}: no such controller{hint}")
        return config

    def _world_name(self, config: Config, chosen: Sequence[Given], values: Sequence[Given]) -> str:
        bundles = [one for one in chosen if one.key == "world"]
        bundle = str(bundles[-1].value) if bundles else "clean"
        if not {one.node for one in values}.union(one.key for one in chosen).intersection((*WORLD, "experiment")):
            return world_name(config, bundle, {group: getattr(config, group) for group in WORLD})  # nothing differs
        key = ("world name", bundle)
        if key not in self._made:
            base = self._whole(bundles[-1:])
            self._made[key] = self._nodes({group: base[group] for group in WORLD}, ())
        return world_name(config, bundle, self._made[key])

    def _nodes(self, base: Mapping[str, Node], values: Sequence[Given]) -> dict[str, Any]:
        """The nodes with their values set, and the values of the root."""
        touching: dict[str, tuple[str, ...]] = {}
        references = {name: node.references for name, node in base.items()}
        for one in values:
            touching[one.node] = (*touching.get(one.node, ()), one.text)
            if not isinstance(one.value, (int, float)):
                references[one.node] += _references(one.value)
        roots = tuple(name for name, node in base.items() if node.schema is None)
        found, lacking = {}, {}
        for name in base:
            # What else decides a node that refers to others: the values of the root, if it refers to nothing else.
            others = references[name] and (roots if set(references[name]) <= set(roots) else tuple(base))
            known = (name, *((base[other].source, touching.get(other)) for other in (name, *others)))
            if known in self._made:
                found[name] = self._made[known]
            else:
                lacking[name] = known, others
        contents = {name: _content(name, base, values, others) for name, (_, others) in lacking.items()}
        if len(self._made) > KEPT:
            self._made.clear()
        for name, (known, _) in lacking.items():
            schema = base[name].schema
            found[name] = contents[name] if schema is None else made(schema, contents[name], f"{name}.")
            self._made[known] = found[name]
        return found

    # -------------------------------------------------------------------------------------------------- what Hydra does
    def _composed(self, name: str, chosen: Sequence[Given], source: tuple[str, ...]) -> dict[str, Node]:
        """What Hydra composes of a file and a choice of options."""
        asked = [name, [one.text for one in chosen]]
        content = self._kept.get(asked)
        if content is None:
            content = self._composed_anew(name, chosen)
            self._kept.put(asked, content)
        found = {**plain(Config), **content} if name == "config" else content
        options = {one.key: one.value for one in chosen}
        return {key: _node(key, value, options, source) for key, value in found.items()}

    def _composed_anew(self, name: str, chosen: Sequence[Given]) -> dict[str, Any]:
        import yaml

        from quadexp.config.hydra_files import composed_files

        try:
            content = composed_files(name, [one.text for one in chosen], self._folders)
        except (yaml.YAMLError, UnicodeDecodeError) as error:
            raise self._unreadable(error) from None
        if name == "config":
            self._check_presets(content, chosen)
        return content

    def _check_presets(self, content: Mapping[Any, Any], chosen: Sequence[Given]) -> None:
        """UsageError where a preset sets a key that the option of its group does not have."""
        options = {one.key: str(one.value) for one in chosen}
        asked = {group: f"{group}={options[group]}" for group in PRESETS if group in options}
        presets = {group: options[group] for group in asked}
        for bundle in options.keys() & BUNDLES.keys():
            for group, option in self._chosen_by(bundle, options[bundle]).items():
                if group in PRESETS and group not in presets:
                    asked[group], presets[group] = f"{bundle}={options[bundle]}", option
        for group, option in presets.items():
            target = PRESETS[group]
            kind = str(content[target].get(SCHEMA)).rpartition("/")[2]
            known = declared(SCHEMAS[target][kind]) if kind in SCHEMAS[target] else {}
            for key in self._file(group, option):
                if known and key != "defaults" and key not in known:
                    given = f"{target}={options[target]}" if target in options else f"the {target}"
                    raise UsageError(f"{asked[group]}: sets {target}.{key}, which {given} does not have")

    def _file(self, group: str, option: str) -> Mapping[str, Any]:
        """What the file of an option says."""
        import yaml

        file = next(path for folder in self._folders if (path := folder / group / f"{option}.yaml").is_file())
        return yaml.safe_load(file.read_text(encoding="utf-8")) or {}

    def _chosen_by(self, bundle: str, option: str) -> dict[str, str]:
        """Group -> option that an option of a bundle chooses."""
        chosen = [one for one in self._file(bundle, option).get("defaults", ()) if isinstance(one, Mapping)]
        pairs = [pair for one in chosen for pair in one.items()]
        return {str(key).removeprefix("override /"): str(value) for key, value in pairs}

    def _whole(self, chosen: Sequence[Given]) -> dict[str, Node]:
        """The whole configuration with some options chosen."""
        key = tuple(one.text for one in chosen)
        if key not in self._wholes:
            self._wholes[key] = self._composed("config", chosen, key)
        return self._wholes[key]

    def _put_together(self, chosen: Sequence[Given], key: tuple[str, ...]) -> dict[str, Node]:
        """The same, from what the experiment and every option are by themselves, where that is the same."""
        if key in self._together:
            return self._together[key]
        # A preset sets values of another group's node, and a bundle chooses options of its parts, presets among them,
        # and may set values of theirs: those are composed together, with the experiment.
        keys = {one.key for one in chosen}
        joined = {"experiment", *BUNDLES, *(g for bundle in keys.intersection(BUNDLES) for g in BUNDLES[bundle])}
        joined |= {g for pair in PRESETS.items() if pair[0] in keys or "remedies" in keys for g in pair}
        together = [one for one in chosen if one.key in joined]
        options = {one.key: one for one in chosen if one.key not in joined}
        settled = self._spoken_for([one for one in together if one.key == "experiment"])
        alone = {name: self._nodes_of(one) for name, one in options.items()}
        if settled is None or any([*nodes] != [name] or name in settled for name, nodes in alone.items()):
            base = self._whole(chosen)
        else:
            base = self._whole(together) | {name: nodes[name] for name, nodes in alone.items()}
        self._together[key] = base
        return base

    def _nodes_of(self, option: Given) -> dict[str, Node]:
        """The nodes that an option decides, as a rule its own."""
        name, source = option.key, (option.text,)
        if option.text in self._alone:
            return self._alone[option.text]
        if (self._folders[0] / name / f"{option.value}.yaml").is_file():
            found = self._composed(f"{name}/{option.value}", (), source)
        else:  # Hydra composes no file by itself that lies elsewhere
            default, whole = self._whole([]), self._whole([option])
            found = {k: node for k, node in whole.items() if k == name or node.content != default[k].content}
        self._alone[option.text] = found
        return found

    def _spoken_for(self, experiments: Sequence[Given]) -> set[str] | None:
        """Nodes in which config.yaml or an experiment sets values itself; None where an experiment chooses options."""
        names = ["config", *(f"experiment/{one.value}" for one in experiments if one.value is not None)]
        asked = ["spoken for", names]
        known = self._kept.get(asked)
        if known is None:
            known = {"nodes": self._spoken_for_in(names)}
            self._kept.put(asked, known)
        return None if known["nodes"] is None else set(known["nodes"])

    def _spoken_for_in(self, names: Sequence[str]) -> list[str] | None:
        import yaml

        found: set[str] = set()
        for name in names:
            file = next(path for folder in self._folders if (path := folder / f"{name}.yaml").is_file())
            try:
                content = yaml.safe_load(file.read_text(encoding="utf-8")) or {}
            except (yaml.YAMLError, UnicodeDecodeError) as error:
                raise self._unreadable(error) from None
            if name != "config" and len(content.get("defaults") or ()) > 1:
                return None
            found |= {str(key) for key in content if key != "defaults"}
        return sorted(found)

    def _unreadable(self, error: Exception) -> UsageError:
        """What is wrong with a file, in one line that names it."""
        mark = getattr(error, "problem_mark", None)
        file = mark.name if mark else getattr(error, "name", None) or self._undecodable()
        place = f", line {mark.line + 1}, column {mark.column + 1}" if mark else ""
        reason = getattr(error, "problem", None) or str(error).splitlines()[0]
        return UsageError(f"{file}{place}: not valid YAML: {reason}")

    def _undecodable(self) -> str:
        for file in (path for folder in self._folders for path in sorted(folder.rglob("*.yaml"))):
            try:
                file.read_text(encoding="utf-8")
            except UnicodeDecodeError:
                return str(file)
        return "a file of the configuration"

    # ---------------------------------------------------------------------------------------------------- the overrides
    def _parse(self, overrides: Sequence[str], *, sweep: bool = False) -> list[Given]:
        return [self._parse_one(text, sweep) for text in overrides]

    def _parse_one(self, text: str, sweep: bool) -> Given:
        known = self._parsed.get(text)
        if known is not None:
            return known
        key, equals, value = text.partition("=")
        if _INTEGER.fullmatch(value) and f"{key}=" in self._parsed:  # the grammar costs half a millisecond a text
            return Given(key, int(value), text)
        if not equals:
            raise UsageError(f"{text!r}: expected KEY=VALUE, such as trajectory.speed=8")
        given = None if key in PATHS and not re.match("[A-Za-z]", value) else plain_override(text)
        given = given or self._read(text)
        if given.key.split("/")[0].split(".")[0] in ("hydra", "schema", "sweep"):
            hint = next((f"; {said}" for begin, said in HYDRA.items() if given.key.startswith(begin)), "")
            raise UsageError(f"{text!r}: not a key of this program{hint}")
        if given.sweep is not None:
            if not sweep:
                raise UsageError(f"{text!r}: several values for one key; use `quadexp evaluate --sweep` for that")
            if given.key in self._options:
                for one in given.sweep:
                    self._parse_one(f"{given.key}={one}", False)
            return given
        if given.key in self._options:
            self._check_option(given)
        if len(self._parsed) > KEPT:
            self._parsed.clear()
        self._parsed[text] = given
        if type(given.value) is int and given.key not in PATHS | self._options.keys():
            self._parsed[f"{key}="] = given
        return given

    def _read(self, text: str) -> Given:
        """An override by Hydra's grammar."""
        from quadexp.config.hydra_files import read_override

        key, _, value = text.partition("=")
        literal = f"{key}={','.join(map(quoted, value.split(',')))}"
        override = read_override(text, self.options)
        if override is None and key in PATHS:  # most letters that a path may have mean nothing to the grammar
            override = read_override(literal, self.options)
        if override is None:
            raise UsageError(
                f"{text!r}: cannot be read as KEY=VALUE: a bracket or quote is left open,"
                " or the value has signs that need quotes (KEY=\"'VALUE'\")"
            )
        found = override.value()
        values = getattr(found, "list", [found]) if "(" not in value else []
        if key in PATHS and any(isinstance(one, (int, float)) for one in values):  # 2024_01 is not the number 202401
            override = read_override(literal, self.options) or override
        if override.is_add() or override.is_force_add() or override.is_delete():
            raise UsageError(f"{text!r}: keys can be set (KEY=VALUE), not added or deleted")
        name = override.key_or_group
        if override.package:
            raise UsageError(f"{text!r}: not a key of this program")
        if not override.is_sweep_override():
            return Given(name, override.value(), f"{name}={override.get_value_element_as_str()}")
        if not override.is_discrete_sweep():
            raise UsageError(f"{text!r}: not a list of values; use commas, range, choice or glob for a sweep")
        return Given(name, None, text, tuple(override.sweep_string_iterator()))

    def _check_option(self, given: Given) -> None:
        options = self.options(given.key)
        if given.value is None and given.key == "experiment":
            return
        if given.value not in options:
            hint = suggestion(str(given.value), options)
            raise UsageError(f"{given.key}={given.value}: no such {given.key}{hint}")


def _node(name: str, content: Any, options: Mapping[str, Any], source: tuple[str, ...]) -> Node:
    """A node with the defaults of its schema; UsageError where its option's file names none."""
    inner = declared(Config)[name].node if name in declared(Config) else None
    if inner is not None:
        schema: type = inner
    elif name in SCHEMAS:
        known = SCHEMAS[name]
        chosen = content.pop(SCHEMA, None) if isinstance(content, dict) else None
        group, _, kind = str(chosen).partition("/")
        if group != name or kind not in known:
            option = f"{name}={options[name]}" if name in options else name
            example = f"defaults: [/schema/{name}/{next(iter(known))}@_here_, _self_]"
            others = f" (schemas of {name}: {', '.join(known)})" if len(known) > 1 else ""
            raise UsageError(f"{option}: its file names no schema of {name}; let it begin with `{example}`{others}")
        schema = known[kind]
    else:
        return Node(source, content, None, _references(content))
    return Node(source, _filled(schema, content, f"{name}."), schema, _references(content))


def _references(content: Any) -> tuple[str, ...]:
    """Names of the values of the root that some content refers to, such as ${seed}; of anything else as it stands."""
    return tuple(_REFERENCE.findall(str(content)))


def _filled(schema: type, content: Mapping[str, Any], prefix: str) -> dict[str, Any]:
    """A node's content over the defaults of its schema; UsageError where it has a key that the schema has not."""
    found = plain(schema)
    for key, value in content.items():
        if key not in found:
            raise UsageError(f"{prefix}{key}: no such key{suggestion(str(key), list(found))}")
        inner = declared(schema)[key].node if key in declared(schema) else None
        filled = inner is not None and isinstance(value, Mapping)
        found[key] = _filled(inner, value, f"{prefix}{key}.") if inner and filled else value
    return found


def _content(name: str, base: Mapping[str, Node], values: Sequence[Given], others: Sequence[str]) -> Any:
    """A node's content with its values set. others: names of what it refers to."""
    content = {one: copy.deepcopy(base[one].content) for one in {name, *others}}
    for one in values:
        if one.node in content:
            _set(content, one.key.split("."), one.value)
    if not others:
        return content[name]
    try:
        return _substituted(content[name], content)
    except LookupError:
        from quadexp.config.hydra_files import resolved

        return resolved(content)[name]


def _substituted(content: Any, others: Mapping[str, Any]) -> Any:
    """The content with its references to numbers of the root replaced; LookupError where there are other references."""
    if isinstance(content, dict):
        return {key: _substituted(value, others) for key, value in content.items()}
    if isinstance(content, list):
        return [_substituted(value, others) for value in content]
    if not isinstance(content, str) or "${" not in content:
        return content
    whole = _WHOLE_REFERENCE.fullmatch(content)
    value = others[whole[1]] if whole else content
    if not isinstance(value, (int, float)):
        raise LookupError(content)
    return value


def _set(content: dict[str, Any], parts: Sequence[str], value: Any) -> None:
    for part in parts[:-1]:
        content = content[part]
    old = content.get(parts[-1])
    if isinstance(old, dict) and isinstance(value, dict):
        for key, item in value.items():
            _set(old, [str(key)], item)
    else:
        content[parts[-1]] = copy.deepcopy(value)


def _check_key(content: Any, key: str, having: Callable[[str], dict[str, list[str]]]) -> None:
    """UsageError where the content has no such key. having: keys of options that are not chosen; see Composer."""
    root, parts = content, key.split(".")
    for i, part in enumerate(parts):
        if not isinstance(content, dict) or part not in content:
            here = [*map(str, root), "experiment"]
            everywhere = [*_keys(root), *here]
            if isinstance(content, dict) and i > 0:
                here = everywhere = [f"{'.'.join(parts[:i])}.{name}" for name in map(str, content)]
            others = {} if ending_in(key, everywhere) else having(key)
            if others:
                of = " or ".join(f"{name} of {' or '.join(options)}" for name, options in others.items())
                asked = "it is a key" if key in others else "did you mean"
                what = of.removeprefix(f"{key} ") if key in others else f"{of}?"
                raise UsageError(f"{key}: no such key; {asked} {what}")
            raise UsageError(f"{key}: no such key{suggestion(key, everywhere, here)}")
        content = content[part]


def _keys(content: Mapping[str, Any], prefix: str = "") -> Iterator[str]:
    for name, value in content.items():
        if isinstance(value, Mapping):
            yield from _keys(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}"


def _written_out(grids: Any, experiment: str) -> Iterator[dict[str, Any]]:
    """The grids of an experiment's `sweep:`, a mapping or a list of them; one with a list under `each` stands for as
    many: what else it has, with each of these, which may have such lists themselves."""
    for grid in grids if isinstance(grids, list) else [grids]:
        if not isinstance(grid, dict):
            raise UsageError(f"experiment={experiment}: `sweep:` must be a mapping {{key: values}}, or a list of them")
        common = {key: values for key, values in grid.items() if key != EACH}
        within = _written_out(grid[EACH], experiment) if EACH in grid else [{}]
        yield from (common | inner for inner in within)


def _product(overrides: Sequence[Given]) -> Grid:
    """The values of every key, as overrides; of a key that is given twice the last counts."""
    grid: dict[str, tuple[str, ...]] = {}
    for one in overrides:
        if one.sweep is None:
            grid[one.key] = (one.text,)
        else:
            grid[one.key] = tuple(f"{one.key}={value}" for value in one.sweep)
    return tuple(grid.values())


def _as_override(value: Any) -> str:
    """A value of an experiment's `sweep:` as the text of an override."""
    if isinstance(value, (list, tuple)):
        return ",".join(map(str, value))
    return "null" if value is None else str(value)


@contextlib.contextmanager
def _one_line() -> Iterator[None]:
    try:
        yield
    except UsageError:
        raise
    except ValueError as error:
        raise UsageError(one_line(error)) from error


@contextlib.contextmanager
def session(extra: Path | None = None) -> Iterator[Composer]:
    """A Composer over conf/, installed plugins and, if given, a user's own folder of the same layout.

    Modules in the user's folder can be named under `_target_`.
    """
    if extra is not None:
        if not extra.is_dir():
            raise UsageError(f"--conf {extra}: no such folder")
        import_from(extra.resolve())
    yield Composer(extra.resolve() if extra is not None else None)


def compose(overrides: Sequence[str] = (), extra: Path | None = None) -> Config:
    """One configuration; see Composer.compose."""
    with session(extra) as composer:
        return composer.compose(overrides)


def expand(overrides: Sequence[str] = (), extra: Path | None = None) -> Cells:
    """All configurations of a sweep; see Composer.expand."""
    with session(extra) as composer:
        return composer.expand(overrides)
