"""Commands as the shells of this system write them. Those of Windows take a backslash for what it is in a path."""

import re
import shlex
import sys
from collections.abc import Sequence

PLAIN = re.compile(r"[\w.=:\\/+-]+")  # of a word that no shell of Windows looks into


def typed(words: Sequence[str]) -> str:
    """A command as a person types it here: cmd.exe leaves single quotes in a word."""
    if sys.platform != "win32":
        return shlex.join(words)
    return " ".join(word if PLAIN.fullmatch(word) else '"' + word.replace('"', '\\"') + '"' for word in words)


def split(text: str) -> list[str]:
    """The words of a command that was typed here. Raises ValueError for a quotation mark without its second one."""
    return shlex.split(text.replace("\\", "\\\\") if sys.platform == "win32" else text)
