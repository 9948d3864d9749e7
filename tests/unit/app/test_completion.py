"""The completion scripts, run in real shells."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

from tmde_edge.cli import main


def made(shell: str, capsys: pytest.CaptureFixture[str]) -> str:
    assert main(["completion", shell]) == 0
    return capsys.readouterr().out


def completed(script: Path, *words: str) -> list[str]:
    """What bash offers for the last word."""
    line = " ".join(words)
    asked = f"""
source {script}
COMP_WORDS=({" ".join(f"'{w}'" for w in words)}); COMP_CWORD={len(words) - 1}; COMP_LINE='{line}'; COMP_POINT={len(line)}
function=$(complete -p tmde-edge | sed 's/.*-F \\([^ ]*\\) .*/\\1/')
$function tmde-edge '{words[-1]}' '{words[-2]}'
printf '%s\\n' "${{COMPREPLY[@]}}"
"""
    done = subprocess.run(
        ["bash", "--norc", "-c", asked], capture_output=True, text=True, check=True, timeout=60, cwd=script.parent
    )
    return [w.strip() for w in done.stdout.split("\n") if w.strip()]


def test_bash_offers_commands_options_scenarios_and_files(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    script = tmp_path / "tmde-edge.bash"
    script.write_text(made("bash", capsys))
    assert {"measure", "simulate", "view", "bench", "report"} <= set(completed(script, "tmde-edge", ""))
    assert completed(script, "tmde-edge", "mea") == ["measure"]
    assert completed(script, "tmde-edge", "simulate", "app") == ["approach"]
    assert "--can-log" in completed(script, "tmde-edge", "--can")
    (tmp_path / "drive.mp4").write_bytes(b"")
    assert "drive.mp4" in completed(script, "tmde-edge", "--dry-run", "dri")


@pytest.mark.skipif(shutil.which("zsh") is None, reason="zsh is not installed")
def test_zsh_takes_the_script(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    script = tmp_path / "_tmde-edge"
    script.write_text(made("zsh", capsys))
    test = f"fpath=({tmp_path} $fpath); autoload -Uz compinit; compinit -u -d {tmp_path}/dump; whence -w _tmde-edge"
    test += "; print $_comps[tmde-edge]"
    done = subprocess.run(["zsh", "-f", "-c", test], capture_output=True, text=True, check=True, timeout=60)
    assert "_tmde-edge: function" in done.stdout
    assert done.stdout.strip().endswith("_tmde-edge")
    assert done.stderr == ""
    subprocess.run(["zsh", "-n", str(script)], check=True, timeout=60)
