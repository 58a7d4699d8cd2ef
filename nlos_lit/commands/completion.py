"""What makes a shell complete ``nlos`` and its arguments: ``source <(nlos completion bash)``."""

from __future__ import annotations

import sys

from nlos_lit.capture.errors import suggest
from nlos_lit.commands.nlos import COMMANDS
from nlos_lit.places import CONF
from nlos_lit.runtime.arguments import groups_of
from nlos_lit.runtime.keys import KEYS

ABOUT = """Print what makes a shell complete commands, settings and choices. In bash, or zsh:

    source <(nlos completion bash)
    source <(nlos completion zsh)
"""
# Bash breaks words at "=", so the word is taken from the line itself, and what stands before "=" is left out.
BASH = """\
_nlos() {{
    local line=${{COMP_LINE:0:COMP_POINT}} words=
    local word=${{line##* }}
    case $COMP_CWORD in
        1) words="{commands}" ;;
        *) case ${{COMP_WORDS[1]}} in
{cases}
            esac ;;
    esac
    COMPREPLY=($(compgen -W "$words" -- "$word"))
    [[ $word == *=* ]] && COMPREPLY=("${{COMPREPLY[@]#"${{word%%=*}}="}}")
    [[ ${{#COMPREPLY[@]}} == 1 && ${{COMPREPLY[0]}} == *= ]] && compopt -o nospace
}}
complete -o default -F _nlos nlos
"""
ZSH = """\
_nlos() {{
    if (( CURRENT == 2 )); then
        compadd {commands}
        return
    fi
    case $words[2] in
{cases}
    esac
    _files
}}
compdef _nlos nlos
"""


def main(arguments: list[str]) -> int:
    """Print the completion for the shell that ``arguments`` name, and return the exit status."""
    if {"-h", "--help"} & set(arguments):
        print(ABOUT.strip())
        return 0
    scripts = {"bash": bash, "zsh": zsh}
    if len(arguments) != 1 or arguments[0] not in scripts:
        found = " ".join(arguments)
        told = f"found {found!r}: {suggest(found, scripts)}" if found else f"there are {', '.join(scripts)}"
        print(f"error: name a shell; {told}", file=sys.stderr)
        return 2
    print(scripts[arguments[0]]())
    return 0


def words_of(command: str) -> list[str]:
    """What may stand behind a command: ``GROUP=CHOICE``, then ``KEY=``.

    Examples:
        >>> words = words_of("reconstruct")
        >>> "method=lct" in words, "scene.path=" in words, words_of("compare")
        (True, True, [])
    """
    composed = (CONF / f"{command}.yaml").exists()
    groups = groups_of(command) if composed else {}
    choices = [f"{group}={name}" for group, names in groups.items() for name in names]
    return [*choices, *(f"{key}=" for key in KEYS.get(command, ()))]


def bash() -> str:
    """The completion for bash."""
    cases = (
        f'            {name}) words="{" ".join(words_of(name))}" ;;' for name in COMMANDS if words_of(name)
    )
    return BASH.format(commands=" ".join(COMMANDS), cases="\n".join(cases))


def zsh() -> str:
    """The completion for zsh."""
    cases = (
        f"        {name}) compadd -S '' {' '.join(words_of(name))} ;;" for name in COMMANDS if words_of(name)
    )
    return ZSH.format(commands=" ".join(COMMANDS), cases="\n".join(cases))
