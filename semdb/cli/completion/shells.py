"""The scripts that make bash and zsh ask `semdb` what fits, and setting them up."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

from semdb.errors import UsageError

BASH = r"""# Completion of semdb for bash; written by `semdb --install-completion`.
_semdb_completion() {
    local kind value program=${1/#\~/$HOME}
    COMPREPLY=()
    {
        read -r kind || return
        while IFS=$'\t' read -r value _; do
            [[ $COMP_LINE == *[\'\"]* ]] || printf -v value %q "$value"
            COMPREPLY+=("$value")
        done
    } < <(_SEMDB_COMPLETE="${COMP_LINE:0:COMP_POINT}" _SEMDB_BREAKS=":" "$program" 2>/dev/null)
    [[ $kind == files ]] || compopt +o default 2>/dev/null
    [[ ${#COMPREPLY[@]} == 1 && ${COMPREPLY[0]} == *[:/] ]] && compopt -o nospace 2>/dev/null
    return 0
}
complete -o default -F _semdb_completion semdb
"""

ZSH = r"""#compdef semdb
# Completion of semdb for zsh; written by `semdb --install-completion`.
_semdb() {
    local line value kind=plain
    local -a answer entries open
    answer=("${(@f)$(_SEMDB_COMPLETE="${(j: :)words[1,CURRENT-1]} $PREFIX" ${~words[1]} 2>/dev/null)}")
    kind=$answer[1]
    compset -P '--*='
    for line in "${(@)answer[2,-1]}"; do
        value=${line%%$'\t'*}
        if [[ $value == *[:/] ]]; then
            open+=("$value")
        else
            entries+=("${value//:/\\:}:${line#*$'\t'}")
        fi
    done
    (( $#entries )) && _describe 'semdb' entries
    (( $#open )) && compadd -S '' -- "${(@)open}"
    if [[ $kind == files && ( $PREFIX != *:* || $#entries == 0 ) ]]; then
        compset -P '*:'
        _files
    fi
}
if [[ $funcstack[1] == _semdb ]]; then
    _semdb "$@"
else
    (( $+functions[compdef] )) || { autoload -Uz compinit && compinit -i; }
    compdef _semdb semdb
fi
"""


@dataclass(frozen=True, slots=True)
class Shell:
    """A shell with its script, and the file that it reads when it starts."""

    name: str
    script: str
    start_file: Path


def current_shell() -> Shell:
    """The shell that semdb was called from, else that of the variable SHELL. Raises UsageError for any other."""
    names = [_calling_shell(), Path(os.environ.get("SHELL", "")).name]
    for name in names:
        if name == "bash":
            return Shell("bash", BASH, Path.home() / ".bashrc")
        if name == "zsh":
            return Shell("zsh", ZSH, Path(os.environ.get("ZDOTDIR") or Path.home()) / ".zshrc")
    found = " or ".join(name for name in dict.fromkeys(names) if name) or "no shell that can be told"
    raise UsageError(f"completion is there for bash and zsh, and this is {found}: run it from one of them")


def _calling_shell() -> str:
    try:
        from shellingham import ShellDetectionFailure, detect_shell
    except ImportError:
        return ""
    try:
        return str(detect_shell()[0])
    except ShellDetectionFailure:
        return ""


def install(shell: Shell) -> Path:
    """Writes the script and has the shell load it: nothing else in the start file is touched. Returns the script.

    Doing it again writes the script anew.
    """
    data = Path(os.environ.get("XDG_DATA_HOME") or Path.home() / ".local" / "share")
    path = data / "semdb" / f"completion.{shell.name}"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(shell.script, encoding="utf-8")
    quoted = "'" + str(path).replace("'", "'\\''") + "'"
    line = f"[ -f {quoted} ] && . {quoted}  # completion of semdb"
    before = b""
    if shell.start_file.exists():
        before = shell.start_file.read_bytes()
    if line.encode() not in before.splitlines():
        with shell.start_file.open("ab") as file:
            file.write(b"" if not before or before.endswith(b"\n") else b"\n")
            file.write(f"{line}\n".encode())
    return path
