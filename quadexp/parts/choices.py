"""What a choice of options makes: by Hydra (hydra_files.py), which composes files, and kept between runs (kept.py).

An option that nothing else speaks of is composed alone and put in place, so that a sweep over many combinations
composes every option once.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from quadexp.errors import UsageError
from quadexp.parts.former_options import FORMER
from quadexp.parts.kept import KeptCompositions
from quadexp.parts.node import Node, node_of
from quadexp.parts.option_files import OptionFiles
from quadexp.parts.override import Given
from quadexp.parts.part import TARGET, part_class
from quadexp.parts.schema import BUNDLES, CHOSEN, PRESETS, Config
from quadexp.parts.settings import declared, plain


class Choices:
    """Composes choices of options, each once."""

    def __init__(self, files: OptionFiles) -> None:
        self._files = files
        self._kept = KeptCompositions(files.folders)
        self._wholes: dict[tuple[str, ...], dict[str, Node]] = {}
        self._together: dict[tuple[str, ...], dict[str, Node]] = {}
        self._alone: dict[str, dict[str, Node]] = {}

    def whole(self, chosen: Sequence[Given]) -> dict[str, Node]:
        """The whole configuration with some options chosen."""
        key = tuple(one.text for one in chosen)
        if key not in self._wholes:
            self._wholes[key] = self._composed("config", chosen, key)
        return self._wholes[key]

    def put_together(self, chosen: Sequence[Given]) -> dict[str, Node]:
        """The same, from what the experiment and every option are by themselves, where that is the same: for many
        configurations with few options."""
        key = tuple(one.text for one in chosen)
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
            base = self.whole(chosen)
        else:
            base = self.whole(together) | {name: nodes[name] for name, nodes in alone.items()}
        self._together[key] = base
        return base

    def _nodes_of(self, option: Given) -> dict[str, Node]:
        """The nodes that an option decides, as a rule its own."""
        name, source = option.key, (option.text,)
        if option.text in self._alone:
            return self._alone[option.text]
        if (self._files.folders[0] / name / f"{option.value}.yaml").is_file():
            found = self._composed(f"{name}/{option.value}", (), source)
        else:  # Hydra composes no file by itself that lies elsewhere
            default, whole = self.whole([]), self.whole([option])
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
        contents = {name: self._files.read(name) for name in names}
        if any(len(content.get("defaults") or ()) > 1 for name, content in contents.items() if name != "config"):
            return None
        return sorted({str(key) for content in contents.values() for key in content if key != "defaults"})

    def _composed(self, name: str, chosen: Sequence[Given], source: tuple[str, ...]) -> dict[str, Node]:
        """What Hydra composes of a file and a choice of options."""
        self._files.check([name, *(f"{one.key}/{one.value}" for one in chosen)])
        asked = [name, [one.text for one in chosen]]
        content = self._kept.get(asked)
        if content is None:
            content = self._composed_anew(name, chosen)
            self._kept.put(asked, content)
        found = {**plain(Config), **content} if name == "config" else content
        options = CHOSEN | {one.key: str(one.value) for one in chosen}
        if name != "config":
            group, _, option = name.partition("/")
            options[group] = option
        return {key: node_of(key, value, options.get(key, ""), source) for key, value in found.items()}

    def _composed_anew(self, name: str, chosen: Sequence[Given]) -> dict[str, Any]:
        from quadexp.parts.hydra_files import composed_files

        content = composed_files(name, [one.text for one in chosen], self._files)
        if name == "config":
            self._check_presets(content, chosen)
        return content

    def _check_presets(self, content: Mapping[Any, Any], chosen: Sequence[Given]) -> None:
        """UsageError where a preset sets a key that the option of its group does not have."""
        options = {one.key: str(one.value) for one in chosen}
        asked = {group: f"{group}={options[group]}" for group in PRESETS if group in options}
        presets = {group: options[group] for group in asked}
        for bundle in options.keys() & BUNDLES.keys():
            for group, option in self._files.chosen_by(f"{bundle}/{options[bundle]}").items():
                if group in PRESETS and group not in presets:
                    asked[group], presets[group] = f"{bundle}={options[bundle]}", option
        for group, option in presets.items():
            target = PRESETS[group]
            named = content[target].get(FORMER) or content[target].get(TARGET)
            known = declared(part_class(target, named)) if named else {}
            for key in self._files.read(f"{group}/{option}"):
                if known and key != "defaults" and key not in known:
                    given = f"{target}={options[target]}" if target in options else f"the {target}"
                    raise UsageError(f"{asked[group]}: sets {target}.{key}, which {given} does not have")
