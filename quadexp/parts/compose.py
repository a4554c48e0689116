"""From overrides to a configuration.

A node of the configuration is what the files say of it that were chosen, one over the other: its option, presets,
bundles, the experiment. A choice of options is put together once. Values are then set in plain dictionaries, and a
node is made, and so checked, once for every set of values. Configurations share their nodes: these cannot be changed.
"""

from __future__ import annotations

import contextlib
import copy
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

from quadexp.errors import UsageError
from quadexp.messages import ending_in, suggestion
from quadexp.names import SPELLINGS, is_name
from quadexp.parts.absent import lacking
from quadexp.parts.cells import Cell as Cell
from quadexp.parts.cells import Cells, as_override, iterate_validated, product, written_out
from quadexp.parts.models import GROUP, check_named, kind_of, spelled
from quadexp.parts.options import GLOBAL, Folders, OptionFiles, given_folders, merge, nested
from quadexp.parts.override import GROUPS, MOST_CELLS, Override, OverrideReader, alternatives
from quadexp.parts.part import TARGET, part_class
from quadexp.parts.reads import is_read, refuse_idle, refuse_unread, refuse_without_effect
from quadexp.parts.references import References
from quadexp.parts.schema import BUNDLES, CHOSEN, CLASSES, PRESETS, WORLD, Config, lacks_plugin, world_name
from quadexp.parts.settings import declared, made, plain
from quadexp.parts.timing import with_timing
from quadexp.parts.user_modules import import_from, own_folders

KEPT = 50_000  # made nodes that are remembered at most
NAMING = ("controller", "evaluate")  # nodes with settings that name options
_ROOT = plain(Config)


class Layer(NamedTuple):
    """What a file says of a node. option: GROUP=OPTION, by: what chose it, where that is a bundle."""

    option: str
    by: str
    values: Any


class Node(NamedTuple):
    """A node before its values are set, or a value of the root. source: the options that it was made from."""

    source: tuple[str, ...]
    content: Any
    schema: type | None


class Composer:
    """Composes configurations from conf/ and a user's own folders (extra); use `session`.

    options(group): names of its options. option, part, parts: see OptionFiles.
    """

    def __init__(self, extra: Folders = None) -> None:
        self._files = OptionFiles(extra)
        self._folders = own_folders()
        self.options = self._files.options
        self.option = self._files.option
        self.part = self._files.part_of
        self.parts = self._files.parts
        self._overrides = OverrideReader(self._files)
        self._trees: dict[tuple[str, ...], dict[str, Node]] = {}
        self._nodes: dict[tuple[str, ...], Node] = {}
        self._made: dict[tuple[Any, ...], Any] = {}
        self._checked: set[tuple[Any, ...]] = set()

    def only(self, command: str, overrides: Sequence[str]) -> None:
        """UsageError where something is given that a command does not read (reads.py)."""
        grids = self._grids(overrides) if is_read("sweep", command) else [self._overrides.read(overrides, sweep=True)]
        for override in (override for grid in grids for override in grid):
            keys = [override.key]
            if override.key == "experiment" and override.value is not None:
                option = self._files.option("experiment", override.value)
                flies_it = "sweep" in option.values and is_read("trajectory", command)
                stated = [*option.chosen, *_keys(option.values)]
                if "sweep" in option.values:  # whose contestants are set so
                    stated = [key for key in stated if not key.startswith("controller.")]
                keys = ["sweep"] if flies_it else stated
            refuse_unread(command, override.text, keys)

    def compose(self, overrides: Sequence[str] = (), command: str | None = None) -> Config:
        """The configuration of one run. command: that is given the overrides, see `only`.

        Raises UsageError with one line: unknown key or option, value of a wrong type or out of range, value missing,
        several values for one key.
        """
        import_from(*self._folders)  # cells are composed when they are asked for, maybe after another session
        if command is not None:
            self.only(command, overrides)
        try:
            return self._compose(self._overrides.read(overrides))
        except ValueError as error:  # of a user's own part
            raise UsageError(" ".join(str(error).split())) from error

    def fitted(self, model: str, overrides: Sequence[str] = (), command: str | None = "fit") -> tuple[Config, Any]:
        """The configuration of a fit, and what is fitted: an option of the group `model` with keys of it set.

        command: see `compose`."""
        option, texts = spelled(model, self._files, overrides)
        of_model = [text for text in texts if text.startswith(f"{GROUP}.")]
        config = self.compose([text for text in texts if text not in of_model], command)
        layers = [Layer(f"{GROUP}={option}", f"{GROUP}={option}", self._files.option(GROUP, option).values)]
        for text in texts:
            if text.startswith("experiment="):
                stated = self._files.option("experiment", text.partition("=")[2]).values
                words = [GROUP, *(word for word, kind in SPELLINGS.items() if kind == kind_of(option, self._files))]
                layers += [Layer(text, text, stated[w]) for w in words if isinstance(stated.get(w), Mapping)]
        self._files.note_covered(GROUP, option)
        node = self._node(GROUP, layers)
        values = self._overrides.read(of_model)
        for override in values:
            check_key({GROUP: node.content}, override.key, self._files)
        schema: Any = node.schema
        part = made(schema, _set(node.content, GROUP, values), f"{GROUP}.")
        for override in values:
            refuse_without_effect(part, override.key, override.text)
        return config, part

    def every(self, group: str) -> list[Any]:
        """The parts of all options of a group, as they are stated."""
        parts = []
        for option in self.options(group):
            text = f"{group}={option}"
            node = self._node(group, [Layer(text, text, self._files.option(group, option).values)])
            schema: Any = node.schema
            parts.append(made(schema, node.content, f"{group}."))
        return parts

    def expand(self, overrides: Sequence[str] = (), *, check: bool = True) -> Cells:
        """Every combination of a sweep: the values on the command line, over those of the experiment's `sweep:`.

        check: compose all of them before any is returned, see `iterate_validated`. They are composed again when they
        are asked for, and a sweep asks for all before it flies the first, so it need not.
        """
        cells = Cells([product(grid) for grid in self._grids(overrides)], self._cell_config)
        if len(cells) > MOST_CELLS:
            raise UsageError(
                f"{len(cells)} combinations; a sweep has at most {MOST_CELLS}: split it, each part with its own --out"
            )
        for _ in iterate_validated(cells) if check else ():
            pass
        return cells

    def _cell_config(self, overrides: Sequence[str]) -> Config:
        config = self.compose(overrides)
        return config if config.sweep is None else replace(config, sweep=None)  # a cell is one flight

    def _grids(self, overrides: Sequence[str]) -> Iterator[list[Override]]:
        """The overrides of every grid: one, or one for each mapping under `sweep:` of the experiments, and for each
        alternative, see override.alternatives."""
        for words in alternatives(overrides):
            yield from self._grids_of(self._overrides.read(words, sweep=True))

    def _grids_of(self, parsed: list[Override]) -> Iterator[list[Override]]:
        experiments = [override for override in parsed if override.key == "experiment"]
        if not experiments:
            yield parsed
            return
        stated = {override.key for override in parsed}
        chosen = experiments[-1]
        names = [chosen.text.partition("=")[2]] if chosen.sweep is None else chosen.sweep
        rest = [override for override in parsed if override.key != "experiment"]
        for name in names:
            choice = self._overrides.read([f"experiment={name}"])
            sweep = self._compose(choice).sweep
            for grid in written_out(sweep or {}, str(name)):
                # The mapping's order is kept: what stands first varies slowest.
                texts = [as_override(key, value) for key, value in grid.items() if key not in stated]
                yield choice + self._overrides.read(texts, sweep=True) + rest

    def _compose(self, parsed: Sequence[Override]) -> Config:
        chosen = [override for override in parsed if override.key in GROUPS]
        values = [override for override in parsed if override.key not in GROUPS]
        tree = self._tree(chosen)
        choice = tuple(override.text for override in chosen)
        for override in values:
            if (choice, override.key) not in self._checked:
                check_key({name: node.content for name, node in tree.items()}, override.key, self._files)
                self._checked.add((choice, override.key))
            if override.key in tree and tree[override.key].schema and not isinstance(override.value, Mapping):
                first = next(iter(tree[override.key].content))
                raise UsageError(f"{override.text}: holds keys; set one of them, such as {override.key}.{first}=...")
        config = Config(**self._parts(tree, values))
        for override in values:
            refuse_idle(config, override.key, override.text)
        if tree["timing"].source != ("timing=none",) or any(override.node == "timing" for override in values):
            options = dict(option.split("=", 1) for option in tree["controller"].source)
            config = with_timing(config, {override.key for override in values}, options.get("motor", ""))
        config = replace(config, world=self._world_name(config, chosen, values))
        if not is_name(config.world):
            raise UsageError(f"world={config.world!r}: its name must be one printable line")
        baseline = config.evaluate.baseline
        if baseline not in self.options("controller"):
            raise UsageError(f"evaluate.baseline={baseline}: {self._files.why_not('controller', baseline)}")
        return config

    def _world_name(self, config: Config, chosen: Sequence[Override], values: Sequence[Override]) -> str:
        bundles = [override for override in chosen if override.key == "world"]
        bundle = str(bundles[-1].value) if bundles else "clean"
        if not {override.node for override in (*values, *chosen)}.intersection((*WORLD, "experiment")):
            return world_name(config, bundle, {group: getattr(config, group) for group in WORLD})  # nothing differs
        tree = self._tree(bundles[-1:])
        return world_name(config, bundle, self._parts({group: tree[group] for group in WORLD}, ()))

    # ------------------------------------------------------------------------------------------- before values are set
    def _tree(self, chosen: Sequence[Override]) -> dict[str, Node]:
        """The whole configuration with some options chosen."""
        choice = tuple(override.text for override in chosen)
        if choice not in self._trees:
            layers = self._layers({override.key: override.value for override in chosen})
            for name in layers:
                if name not in _ROOT:
                    unknown = lacking(name) if lacks_plugin(name) else f"no such key{suggestion(name, list(_ROOT))}"
                    raise UsageError(f"{layers[name][0].option}: {name}: {unknown}")
            self._trees[choice] = {name: self._node(name, layers.get(name, [])) for name in _ROOT}
        return self._trees[choice]

    def _layers(self, stated: Mapping[str, Any]) -> dict[str, list[Layer]]:
        """What says something of each node, the first first. An option that is given counts over that of the
        experiment, this over those of bundles, the last first."""
        experiment = stated.get("experiment")
        chosen_by: dict[str, str] = {}
        of_experiment = self._files.option("experiment", experiment).chosen if experiment else {}
        options = {**CHOSEN, **of_experiment, **stated}
        for bundle in BUNDLES:
            chosen = self._files.option(bundle, options[bundle]).chosen
            others = [
                f"{group}={stated[group]}" for group, option in chosen.items() if stated.get(group, option) != option
            ]
            if bundle == "remedies" in stated and len(others) == len(chosen) > 0:
                raise UsageError(
                    f"{bundle}={options[bundle]}: nothing of it is left beside {' '.join(others)}; give one of them"
                )
            for group, option in chosen.items():
                if group not in stated and group not in of_experiment:
                    options[group], chosen_by[group] = option, f"{bundle}={options[bundle]}"
        layers: dict[str, list[Layer]] = {}
        for group in (*CHOSEN, "experiment"):
            if options.get(group) is None:
                continue
            option = str(options[group])
            values = self._files.option(group, option).values
            text = f"{group}={option}"
            self._files.note_covered(group, option)
            if group in GLOBAL:
                for name, value in values.items():
                    if name in SPELLINGS or (name == GROUP and isinstance(value, Mapping)):
                        continue  # of what is fitted, see `fitted`
                    layers.setdefault(name, []).append(Layer(text, text, value))
            else:
                layers.setdefault(PRESETS.get(group, group), []).append(Layer(text, chosen_by.get(group, text), values))
        return layers

    def _node(self, name: str, layers: Sequence[Layer]) -> Node:
        """Made once from the same options, so that a sweep over many choices of options costs little."""
        source = tuple(layer.option for layer in layers)
        if (name, *source) not in self._nodes:
            self._nodes[name, *source] = Node(source, *_joined(name, layers, self._files))
        return self._nodes[name, *source]

    # -------------------------------------------------------------------------------------------------- values are set
    def _parts(self, tree: Mapping[str, Node], values: Sequence[Override]) -> dict[str, Any]:
        """The nodes, made with their values set, and the values of the root."""
        of_node: dict[str, list[Override]] = {}
        for override in values:
            of_node.setdefault(override.node, []).append(override)

        def content(name: str) -> Any:
            return _set(tree[name].content, name, of_node.get(name, ()))

        if len(self._made) > KEPT:
            self._made.clear()
        nodes: dict[str, Any] = {}
        references = References(_ROOT, content)
        for name, node in tree.items():
            key = (name, node.source, *(override.text for override in of_node.get(name, ())))
            if key not in self._made:
                whole = content(name)
                refers = "${" in str(whole)
                whole = references.resolved(whole, name) if refers else whole
                nodes[name] = whole if node.schema is None else made(node.schema, whole, f"{name}.")
                if name in NAMING:
                    check_named(nodes[name])
                if refers:  # what it is hangs on other nodes too
                    continue
                self._made[key] = nodes[name]
            nodes[name] = self._made[key]
        return nodes


def _joined(name: str, layers: Sequence[Layer], files: OptionFiles) -> tuple[Any, type | None]:
    """The content of a node over the defaults of its class, and that class, None for a value of the root.

    What an experiment sets holds for the options that have it. UsageError where the option's file names no class, or
    something else sets a key that the class has not.
    """
    schema = declared(Config)[name].node if name in declared(Config) else None
    of_part = name in CLASSES and layers and isinstance(layers[0].values, Mapping)
    if schema is None and not of_part:  # such as model=PATH
        return (layers[-1].values if layers else _ROOT[name]), None
    content: dict[str, Any] = {}
    for layer in layers:
        if not isinstance(layer.values, Mapping):
            raise UsageError(f"{layer.option}: {name}: must hold keys and values")
        merge(content, layer.values)
    if schema is None:
        option = layers[0].option
        target = content.pop(TARGET, None)
        if target is None:
            raise UsageError(
                f"{option}: its file names no class; let it begin with `{TARGET}: MODULE.CLASS`, or extend another"
                f" option of {name}: `defaults: [OPTION, _self_]`"
            )
        schema = part_class(name, target)
        for layer in layers[1:]:
            for key in layer.values:
                if key in declared(schema):
                    continue
                if layer.option.startswith("experiment=") and f"{name}.{key}" in files.having(key):
                    content.pop(key, None)
                else:
                    raise UsageError(f"{layer.by}: sets {name}.{key}, which {option} does not have")
        content.setdefault("name", option.partition("=")[2])
    filled = plain(schema)
    merge(filled, content)
    return filled, schema


def check_key(content: Any, key: str, files: OptionFiles) -> None:
    """UsageError where the content has no such key. files: the options, those that are not chosen too."""
    root = content
    parts = key.split(".")
    if lacks_plugin(parts[0]):
        raise UsageError(f"{key}: {lacking(parts[0])}")
    for i, part in enumerate(parts):
        if isinstance(content, dict) and part in content:
            content = content[part]
            continue
        others = files.having(key)
        if isinstance(content, dict) and [*content] == ["name"] and key not in others:
            group = parts[0]
            keys = ((o, name) for o, part in files.parts(group).items() for name in declared(part) if name != "name")
            there = next((f"; {group}={option} has {group}.{name}" for option, name in keys), "")
            about = f"{group}={content['name']} has no settings{there}"
            raise UsageError(f"{key}: {about}; `quadexp options {group}` lists what there is")
        if key in others:
            raise UsageError(f"{key}: no such key; it is a key of {' or '.join(others[key])}")
        here = [*root, "experiment", *BUNDLES, *PRESETS]
        everywhere = [*_keys(root), *here]
        if isinstance(content, dict) and i > 0:
            here = everywhere = [f"{'.'.join(parts[:i])}.{name}" for name in content]
        if others and not ending_in(key, everywhere):
            options = " or ".join(f"{name} of {' or '.join(named)}" for name, named in others.items())
            raise UsageError(f"{key}: no such key; did you mean {options}?")
        raise UsageError(f"{key}: no such key{suggestion(key, everywhere, here)}")


def _keys(content: Mapping[str, Any], prefix: str = "") -> Iterator[str]:
    for name, value in content.items():
        if isinstance(value, Mapping):
            yield from _keys(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}"


def _set(content: Any, name: str, values: Sequence[Override]) -> Any:
    """A copy of a node's content with values set."""
    whole = {name: copy.deepcopy(content)}
    for override in values:
        merge(whole, nested(override.key, override.value))
    return whole[name]


# ----------------------------------------------------------------------------------------------------------- sessions
@contextlib.contextmanager
def session(extra: Folders = None) -> Iterator[Composer]:
    """A Composer over a user's own folders, if given, installed plugins and conf/.

    Modules in the user's folders can be named under `_target_`. Raises UsageError where one is no folder of options.
    """
    yield Composer(given_folders(extra))


def compose(overrides: Sequence[str] = (), extra: Folders = None, command: str | None = None) -> Config:
    """One configuration; see Composer.compose."""
    with session(extra) as composer:
        return composer.compose(overrides, command)


def expand(overrides: Sequence[str] = (), extra: Folders = None) -> Cells:
    """All configurations of a sweep; see Composer.expand."""
    with session(extra) as composer:
        return composer.expand(overrides)
