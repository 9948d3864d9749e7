# Sourced by the other scripts: a virtual environment with exactly the locked versions. Needs python3, python3-venv, git.

find_python() { # prints a Python from 3.10 on: TMDE_PYTHON, else python3
  local python="${TMDE_PYTHON:-python3}"
  if ! command -v "$python" >/dev/null; then
    echo "$python is missing. On Debian, Ubuntu, Raspberry Pi OS: sudo apt install python3 python3-venv" >&2
    return 1
  fi
  if ! "$python" -c 'import sys; sys.exit(sys.version_info < (3, 10))'; then
    echo "$("$python" --version) is too old: 3.10 or newer is needed (name one with TMDE_PYTHON=python3.11)" >&2
    return 1
  fi
  if ! "$python" -c 'import ensurepip, venv' 2>/dev/null; then
    echo "Python's venv is missing. On Debian, Ubuntu, Raspberry Pi OS: sudo apt install python3-venv" >&2
    return 1
  fi
  echo "$python"
}

make_venv() { # FOLDER LOCK...: made once, renewed when a lock file, the project's metadata or the Python changed
  local folder="$1" python stamp
  shift
  python="$(find_python)" || return 1
  stamp="$({ "$python" --version; pwd; cat pyproject.toml "$@"; } | sha256sum)"
  if [ -x "$folder/bin/python" ] && [ "$(cat "$folder/.locked" 2>/dev/null)" = "$stamp" ]; then
    return 0
  fi
  if [ -L "$folder" ]; then # what lies elsewhere belongs to others too: `venv --clear` would empty it
    echo "$folder is a link to $(readlink "$folder"), which has other versions than $*; renew it there, or remove the link" >&2
    return 1
  fi
  echo "making $folder ($("$python" --version), versions of $*)" >&2
  "$python" -m venv --clear "$folder" || return 1
  local locks=()
  for lock in "$@"; do locks+=(-r "$lock"); done
  "$folder/bin/python" -m pip install -q --disable-pip-version-check --no-deps "${locks[@]}" || return 1
  "$folder/bin/python" -m pip install -q --disable-pip-version-check --no-deps -e . || return 1
  echo "$stamp" >"$folder/.locked"
}
