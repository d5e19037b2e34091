"""The command pegasus-completion: what makes a shell complete the words of every command, from their tables.

A script holds all words, so that completing starts no Python.
"""

import sys
from collections.abc import Sequence

from pegasus_jax.checks import ConfigError, did_you_mean
from pegasus_jax.cli import words as tables
from pegasus_jax.cli.main import main

COMPLETION = """\
pegasus-completion bash|zsh|fish     print a script that makes your shell complete commands and settings

For bash or zsh, add one line at the end of ~/.bashrc or ~/.zshrc. For fish, write a file:

  eval "$(pegasus-completion bash)"
  eval "$(pegasus-completion zsh)"            after compinit
  pegasus-completion fish > ~/.config/fish/completions/pegasus.fish
"""

HELP = ("--help", "--version")


def completion() -> None:
    """Entry point of pegasus-completion."""
    main(handle, COMPLETION, stopped="nothing was printed")


def handle(words: Sequence[str]) -> None:
    """Print the script of a shell. Raises ConfigError for one that is not known."""
    if len(words) != 1 or words[0] not in SHELLS:
        name = " ".join(words)
        raise ConfigError(f"{name} is no shell whose completion is known; {did_you_mean(name, SHELLS)}")
    sys.stdout.write(SHELLS[words[0]]())


def commands() -> dict[str, dict[str, str]]:
    """Command -> its words, each with what it is for."""
    train = tables.of_train()
    known = {name: dict.fromkeys(more, "") | train for name, more in tables.MORE.items()}
    return known | {name: dict.fromkeys(options, "") for name, options in tables.OF_RUN.items()}


def values() -> dict[str, tuple[str, ...]]:
    """Word -> its values, of those that have few."""
    train = {word: tables.values(word) for word in tables.of_train()}
    return {word: found for word, found in (train | tables.OF_RUN_VALUES).items() if found}


def bash() -> str:
    """Of bash. It splits words at =, so that what completes a value is the value alone."""
    known = {word: (f'values="{" ".join(found)}"') for word, found in values().items()}
    return f"""\
_pegasus() {{
    local line="${{COMP_LINE:0:COMP_POINT}}" words values='' key start IFS=$' \\t\\n'
    local word="${{line##* }}"
    COMPREPLY=()
    case "${{1##*/}}" in
{_cases({name: f'words="{" ".join([*(f"{w}=" for w in of), *HELP])}"' for name, of in commands().items()}, 8)}
    esac
    if [[ "$word" != *=* ]]; then
        COMPREPLY=($(compgen -W "$words" -- "$word"))
        IFS=$'\\n'
        case "$1" in
            {"|".join(f"*{name}" for name in tables.OF_RUN)}) COMPREPLY+=($(compgen -d -- "$word")) ;;
        esac
        [[ "${{COMPREPLY[0]}}" == *= ]] && compopt -o nospace 2>/dev/null
        [[ -d "${{COMPREPLY[0]}}" ]] && compopt -o filenames 2>/dev/null
        return
    fi
    key="${{word%%=*}}" start="${{word#*=}}"
    case "$key" in
{_cases(known, 8)}
    esac
    COMPREPLY=($(compgen -W "$values" -- "$start"))
    IFS=$'\\n'
    case "$key" in
        {"|".join(tables.PATHS)}) compopt -o filenames 2>/dev/null; COMPREPLY=($(compgen -f -- "$start")) ;;
    esac
    [[ "$COMP_WORDBREAKS" == *=* ]] || COMPREPLY=("${{COMPREPLY[@]/#/$key=}}")
}}
complete -F _pegasus {" ".join(commands())}
"""


def zsh() -> str:
    """Of zsh."""
    described = {
        name: "words=(" + " ".join(_quoted(f"{w}=:{text}" if text else f"{w}=") for w, text in of.items()) + ")"
        for name, of in commands().items()
    }
    known = {word: f"compadd -- {' '.join(found)}" for word, found in values().items()}
    return f"""\
#compdef {" ".join(commands())}
_pegasus() {{
    local -a words
    if compset -P 1 '*='; then
        case "${{${{IPREFIX%=}}##* }}" in
{_cases(known, 12)}
            {"|".join(tables.PATHS)}) _files ;;
        esac
        return
    fi
    case "${{service:t}}" in
{_cases(described, 8)}
    esac
    _describe -t words word words -S ''
    compadd -- {" ".join(HELP)}
    case "${{service:t}}" in
        {"|".join(tables.OF_RUN)}) _files -/ ;;
    esac
}}
compdef _pegasus {" ".join(commands())}
"""


def fish() -> str:
    """Of fish, which completes a word as a whole."""
    known = {
        f"{word}=*": f"printf '%s\\n' {' '.join(f'{word}={v}' for v in found)}" for word, found in values().items()
    }
    paths = " ".join(f"'{word}=*'" for word in tables.PATHS)
    lines = [
        "function __pegasus_value",
        "    set -l word (commandline -ct)",
        "    set -l key (string replace -r '=.*' '' -- $word)",
        "    switch $word",
        *(f"        case '{word}'\n            {do}" for word, do in known.items()),
        f"        case {paths}",
        "            for path in (__fish_complete_path (string replace -r '^[^=]*=' '' -- $word))",
        "                echo $key=$path",
        "            end",
        "    end",
        "end",
        *(f"complete -c {name} -f -a '(__pegasus_value)'" for name in commands()),
        *(f"complete -c {name} -a '(__fish_complete_directories)'" for name in tables.OF_RUN),
    ]
    for name, of in commands().items():
        lines += [f"complete -c {name} -a {_quoted(f'{word}=')} -d {_quoted(text)}" for word, text in of.items()]
        lines += [f"complete -c {name} -l {option.lstrip('-')}" for option in HELP]
    return "\n".join(lines) + "\n"


SHELLS = {"bash": bash, "zsh": zsh, "fish": fish}


def _cases(of: dict[str, str], spaces: int) -> str:
    """The branches of a `case`, indented; those that do the same are one."""
    same: dict[str, list[str]] = {}
    for name, do in of.items():
        same.setdefault(do, []).append(name)
    return "\n".join(f"{' ' * spaces}{'|'.join(names)}) {do} ;;" for do, names in same.items())


def _quoted(text: str) -> str:
    """A text in single quotes, which no shell looks into; its own quotes become typographic."""
    return "'" + text.replace("\\", "/").replace("'", "’") + "'"
