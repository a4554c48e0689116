"""The models that are learned: options of the group `model`, and the words for the shipped ones of before.

A model has a kind, the name of the option that states its class: `controller.residual=KIND` flies its checkpoint. Other
options of the group are presets: they extend one of these.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache, lru_cache
from pathlib import Path

from quadexp.errors import UsageError
from quadexp.names import SPELLINGS
from quadexp.parts.options import OptionFiles, absent_options
from quadexp.parts.part import TARGET, Part
from quadexp.parts.schema import conf_folder
from quadexp.parts.settings import Declared, Settings, declared, made, plain
from quadexp.parts.user_modules import OWN, generation, load, own_folders
from quadexp.plugin import shipped_places

GROUP = "model"


def kinds() -> list[str]:
    """Every kind of this program, of the --conf folders and of installed packages."""
    files = OptionFiles(own_folders())
    return [name for name in files.options(GROUP) if TARGET in files.read(GROUP, name)[1]]


@cache
def is_shipped(kind: str) -> bool:
    """Whether it is a kind of this program, and no user's own."""
    return kind in shipped_places("models")


def model_part(kind: str) -> Part:
    """The part of a kind, with the settings that its option states, of the class as it is now.

    Raises UsageError where there is none."""
    own_files = [Path(folder) / GROUP / f"{kind}.yaml" for folder in own_folders()]
    written = tuple(path.stat().st_mtime_ns for path in own_files if path.is_file())
    part = _model_part(kind, own_folders(), (generation(), *written))
    before = generation()
    load(type(part).__module__)  # executed anew where its file has changed
    return part if generation() == before else model_part(kind)


@lru_cache(64)  # asked for with every cell of a sweep
def _model_part(kind: str, folders: tuple[str, ...], version: tuple[int, ...]) -> Part:
    files = OptionFiles(folders)
    part = files.part_of(GROUP, kind) if kind in files.options(GROUP) else None
    if part is None:
        where = f"the --conf folder {folders[-1]}" if folders else "a --conf folder (none is given)"
        raise UsageError(f"{GROUP}={kind}: there is no {GROUP}/{kind}.yaml in {where}, nor in an installed package")
    stated = {key: value for key, value in files.option(GROUP, kind).values.items() if key != TARGET}
    return made(part, {**plain(part), "name": kind, **stated}, part.prefix)


def named_by(about: Declared) -> tuple[str, ...]:
    """What a setting may name (Setting.options); () where it names no options."""
    group = about.setting.options
    if not group or about.words:
        return ()
    return (*about.setting.also, *(kinds() if group == GROUP else OptionFiles(own_folders()).options(group)))


def check_named(settings: Settings) -> None:
    """Raise UsageError where a setting has to name options of a group, and names something else."""
    for name, about in declared(type(settings)).items():
        if not about.setting.options or about.words:
            continue
        value = getattr(settings, name)
        names = (value,) if isinstance(value, str) else value
        unknown = [word for word in names if word not in about.setting.also and not _is_shipped_option(word)]
        if unknown or not names:
            allowed = named_by(about)
            wrong = [word for word in unknown if word not in allowed] or [] if names else ["[]"]
            if wrong:
                group = about.setting.options
                others = f"must be one of {', '.join(allowed)}, or an own {group}/NAME.yaml in a --conf folder"
                reason = absent_options().get(f"{group}/{wrong[0]}", others)
                raise UsageError(f"{settings.prefix}{name}={wrong[0]}: {reason}")


@cache
def _is_shipped_option(kind: str) -> bool:
    """Whether it is a kind of this package, without a look at all options."""
    return is_shipped(kind) and (conf_folder() / GROUP / f"{kind}.yaml").is_file()


def spelled(model: str, files: OptionFiles, overrides: Sequence[str]) -> tuple[str, list[str]]:
    """The option that `fit MODEL` fits, and the overrides with keys of it as model.KEY; see SPELLINGS."""
    option = SPELLINGS.get(model, model)
    texts = []
    for text in overrides:
        key, _, value = text.partition("=")
        word, dot, name = key.partition(".")
        if word not in SPELLINGS:
            texts.append(text)
        elif SPELLINGS[word] != kind_of(option, files):
            raise UsageError(f"{text}: is not used by fit {model}; it is for fit {SPELLINGS[word]}")
        elif dot:
            texts.append(f"{GROUP}.{name}={value}")
        else:
            option = SPELLINGS[word] if value == "default" else f"{word}_{value}"
    kind_of(option, files)
    return option, texts


def kind_of_class(part: type) -> str:
    """The kind of a class: its module has the name of the option."""
    return part.__module__.rpartition(".")[2]


def maker(kind: str) -> str:
    """The command that makes a checkpoint of a kind."""
    return f"quadexp fit {kind} DATASET --out models/{kind}"


def kind_of(option: str, files: OptionFiles) -> str:
    """The kind of models that an option fits. Raises UsageError where there is no such option."""
    options = files.options(GROUP)
    if option not in options:
        raise UsageError(f"fit {option}: {files.why_not(GROUP, option)}")
    part = files.part_of(GROUP, option)
    if part is None:
        raise UsageError(f"{GROUP}={option}: its file names no class; let it begin with `{TARGET}: MODULE.CLASS`")
    kind = kind_of_class(part)
    if is_shipped(kind) and part.__module__.partition(".")[0] != OWN:
        raise UsageError(f"{GROUP}={option}: this program has models of kind {kind} too: give {kind}.py another name")
    if kind not in options:
        raise UsageError(
            f"{GROUP}={option}: its class is in the module {kind}, so an option {GROUP}/{kind}.yaml is needed"
        )
    return kind
