"""The damages: a file of a run's folder, and what is done to it."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

Change = Callable[[Path], object]  # of the path


class Damage(NamedTuple):
    """One file, one way."""

    path: str
    """in the run's folder; a * stands for the first of several"""
    how: str
    change: Change
    other_end: bool = False
    """whether a resume may rightly end in another way"""

    def do(self, run: Path) -> None:
        """Damage the copy."""
        parent, _, name = self.path.rpartition("/")
        found = sorted((run / parent).glob(name)) if "*" in name else [run / self.path]
        self.change(found[0])

    def outside(self, home: Path) -> bool:
        """Whether a file outside the run, to which a link of it points, was written to."""
        path = home / "outside"
        return path.exists() and path.read_text() != OUTSIDE


OUTSIDE = "somebody else's file\n"


def gone(path: Path) -> None:
    shutil.rmtree(path) if path.is_dir() else path.unlink(missing_ok=True)


def filled(content: bytes) -> Change:
    def change(path: Path) -> None:
        gone(path)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)

    return change


def edited(edit: Callable[[bytes], bytes]) -> Change:
    return lambda path: path.write_bytes(edit(path.read_bytes()))


def flipped(where: float) -> Change:
    def edit(content: bytes) -> bytes:
        place = int(where * (len(content) - 1))
        return content[:place] + bytes([content[place] ^ 16]) + content[place + 1 :]

    return edited(edit)


def folder_there(path: Path) -> None:
    gone(path)
    path.mkdir(parents=True)


def linked_outside(path: Path) -> None:
    """A link to a file beside the run, which nobody may write to through it."""
    gone(path)
    run = next(parent for parent in path.parents if parent.name == "run")
    outside = run.parent / "outside"
    outside.write_text(OUTSIDE)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.symlink_to(outside)


def loop(path: Path) -> None:
    gone(path)
    path.symlink_to(path.name)


def copied(suffix: str) -> Change:
    """A copy beside it, as file managers make them."""
    return lambda path: shutil.copyfile(path, path.with_name(f"{path.stem}{suffix}{path.suffix}"))


def swapped(other: str) -> Change:
    def change(path: Path) -> None:
        first, second = path.read_bytes(), path.with_name(other).read_bytes()
        path.write_bytes(second)
        path.with_name(other).write_bytes(first)

    return change


def arrays(edit: Callable[[dict[str, np.ndarray]], object]) -> Change:
    """An .npz file with other arrays: `edit` changes the dictionary."""

    def change(path: Path) -> None:
        with np.load(path) as file:
            held = {name: file[name] for name in file.files}
        edit(held)
        np.savez(path, **held)  # type: ignore[arg-type]

    return change


def put(name: str, of: Callable[[np.ndarray], object]) -> Change:
    return arrays(lambda held: held.update({name: np.asarray(of(held[name]))}))


def holed(array: np.ndarray, value: float) -> np.ndarray:
    array = array.copy()
    array.flat[array.size // 2] = value
    return array


def npy(path: Path) -> None:
    with path.open("wb") as file:
        np.save(file, np.zeros(3))


def lines(edit: Callable[[list[bytes]], list[bytes]]) -> Change:
    return edited(lambda content: b"".join(edit(content.splitlines(keepends=True))))


def replaced(old: str, new: str) -> Change:
    def edit(content: bytes) -> bytes:
        assert old.encode() in content, f"{old} is not there: the damage would be none"
        return content.replace(old.encode(), new.encode(), 1)

    return edited(edit)


def unreadable(path: Path) -> None:
    """Mode 0; nothing to root."""
    path.chmod(0)


WAYS: dict[str, Change] = {
    "deleted": gone,
    "emptied": filled(b""),
    "cut in half": edited(lambda content: content[: len(content) // 2]),
    "last byte gone": edited(lambda content: content[:-1]),
    "garbage": filled(bytes(range(255, -1, -1)) * 3),
    "zeroed": edited(lambda content: bytes(len(content))),
    "bit flipped at .2": flipped(0.2),
    "bit flipped at .5": flipped(0.5),
    "bit flipped at .9": flipped(0.9),
    "a folder": folder_there,
    "a link to itself": loop,
    "not readable": unreadable,
}
JSON_WAYS = {f"holds {text}": filled(text.encode()) for text in ("[1]", "null", "[]", "{}", '"a"', "3", "[[1]]", "\n")}
LINES: dict[str, Change] = {
    "first row gone": lines(lambda rows: rows[1:]),
    "last row gone": lines(lambda rows: rows[:-1]),
    "first row twice": lines(lambda rows: [rows[0], *rows]),
    "last row twice": lines(lambda rows: [*rows, rows[-1]]),
    "rows out of order": lines(lambda rows: rows[::-1]),
    "a row of another kind": lines(lambda rows: [rows[0], b'{"a": 1}\n']),
    "a row that is a number": lines(lambda rows: [rows[0], b"7\n"]),
    "not UTF-8": lines(lambda rows: [rows[0], b"\xff\xfe\n"]),
    "a NaN": lines(lambda rows: [rows[0], b'{"trial": NaN}\n']),
    "a link outside": linked_outside,
}
ARRAYS: dict[str, Change] = {
    "a row of x gone": put("x", lambda x: x[:-1]),
    "a column of x gone": put("x", lambda x: x[..., :-1]),
    "a column more": put("x", lambda x: np.concatenate([x, x[..., :1]], axis=-1)),
    "x flat": put("x", np.ravel),
    "x empty": put("x", lambda x: x[:0]),
    "u shorter": put("u", lambda u: u[:-3]),
    "u wider": put("u", lambda u: np.concatenate([u, u], axis=-1)),
    "x of strings": put("x", lambda x: x.astype(str)),
    "x of integers": put("x", lambda x: x.astype(np.int64)),
    "x complex": put("x", lambda x: x + 1j),
    "u of truth values": put("u", lambda u: u > 0),
    "x of objects": put("x", lambda x: x.astype(object)),
    "a NaN in x": put("x", lambda x: holed(x, np.nan)),
    "infinity in u": put("u", lambda u: holed(u, np.inf)),
    "a NaN in cost": put("cost", lambda cost: holed(cost, np.nan)),
    "u beyond its limits": put("u", lambda u: holed(u, 1e6)),
    "no x": arrays(lambda held: held.pop("x")),
    "no u": arrays(lambda held: held.pop("u")),
    "no cost": arrays(lambda held: held.pop("cost")),
    "an .npy": npy,
    "a ZIP with nothing in it": filled(b"PK\x05\x06" + bytes(18)),
}


def others() -> list[Damage]:
    """Damages of one file each."""
    third, second = "episodes/0003.npz", "episodes/0002.npz"
    trial_9 = arrays(lambda held: held.update(trial=np.asarray(9)))
    task = arrays(lambda held: held.update(task=np.asarray("swimmer")))
    sums = json.dumps({"../../../outside": "0" * 64}).encode()
    return [
        Damage(second, "swapped with 3", swapped("0003.npz")),
        Damage(third, "the one of trial 2", lambda path: shutil.copyfile(path.with_name("0002.npz"), path)),
        Damage(third, "says that it is of trial 9", trial_9),
        Damage(third, "says that it is another task's", task),
        Damage(third, "copied", copied(" (copy)")),
        Damage("imagined/0002.npz", "copied", copied(" (copy)")),
        Damage("checkpoints/0002.json", "copied", copied(" (copy)")),
        Damage("checkpoints/0002.json", "copied as a number", copied(".5")),
        Damage("checkpoints/0002.json", "sums of a file outside", filled(sums)),
        Damage(
            "checkpoints/0002.json", "sums of trial 1", lambda path: shutil.copyfile(path.with_name("0001.json"), path)
        ),
        Damage("config.yaml", "another width of the model", replaced("- 8", "- 9"), other_end=True),
        Damage("config.yaml", "another task", replaced("task: cartpole", "task: double_cartpole")),
        Damage("config.yaml", "an unknown key", lambda path: path.write_text(path.read_text() + "unknown: 1\n")),
        Damage("config.yaml", "twice the same key", lambda path: path.write_text(path.read_text() + "seed: 1\n")),
        Damage("config.yaml", "a word for a number", replaced("trials: 3", "trials: three")),
        Damage("config.yaml", "fewer trials", replaced("trials: 3", "trials: 1")),
        Damage("config.yaml", "an environment variable", replaced("trials: 3", "trials: ${oc.env:HOME}")),
        Damage("config.yaml", "a link outside", linked_outside),
        Damage("run.json", "a link outside", linked_outside),
        Damage("plots/learning.png", "a link outside", linked_outside),
        Damage("plots/trial_0002.png", "a link outside", linked_outside),
        Damage(third, "a link outside", linked_outside),
        Damage("checkpoints/0003.json", "a link outside", linked_outside),
        *(Damage(name, "deleted", gone) for name in ("episodes", "imagined", "checkpoints", "tensorboard", "plots")),
        *(Damage(name, "a file", filled(b"x")) for name in ("imagined", "tensorboard", "plots")),
        *(Damage(name, "a file", filled(b"x"), other_end=True) for name in ("episodes", "checkpoints")),
        *(Damage(".lock", how, change) for how, change in (("garbage", filled(b"\xff")), ("a folder", folder_there))),
    ]


def all_damages() -> list[Damage]:
    """Every file with every way that makes sense for its kind."""
    files = ["config.yaml", "run.json", "trials.jsonl", "episodes/0003.npz", "episodes/0001.npz", "imagined/0002.npz"]
    files += ["checkpoints/0002.json", "checkpoints/0002/*", "tensorboard/events*", "plots/learning.png"]
    damages = [Damage(path, how, change) for path in files for how, change in WAYS.items()]
    json_files = ("run.json", "config.yaml", "trials.jsonl", "checkpoints/0002.json")
    damages += [Damage(path, how, change) for path in json_files for how, change in JSON_WAYS.items()]
    damages += [Damage("trials.jsonl", how, change) for how, change in LINES.items()]
    episodes = ("episodes/0003.npz", "imagined/0002.npz")
    damages += [Damage(path, how, change) for path in episodes for how, change in ARRAYS.items()]
    return damages + others()


DAMAGES = all_damages()
