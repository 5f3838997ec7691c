"""What ``lae-sim`` says and prints by itself: its version, and what completes it in a shell."""

import shutil
import subprocess
import sys
from importlib import metadata

import numpy as np
import pytest
from command_line import ENVIRONMENT, run_here, run_process

import lae_sim
from lae_sim.cli.main import EXTRAS


def test_the_version_names_what_results_rest_on_and_the_extras_found(monkeypatch):
    def version(name):
        if name == "torch":
            raise metadata.PackageNotFoundError(name)
        return "1.2.3" if name in EXTRAS.values() else found(name)

    found = metadata.version
    monkeypatch.setattr(metadata, "version", version)
    done = run_here("--version")
    first, *others = done.stdout.splitlines()
    assert (done.returncode, first) == (0, f"lae-sim {lae_sim.__version__}")
    assert f"numpy {np.__version__}" in others
    assert "extra torch: no torch (pip install 'lae-sim[torch]')" in others
    assert "extra mat73: h5py 1.2.3" in others
    assert [line.split()[1][:-1] for line in others if line.startswith("extra ")] == [*EXTRAS]


def test_the_version_imports_none_of_what_it_names():
    script = (
        "import sys; from lae_sim.cli.main import version_text; version_text(); "
        "print({'numpy', 'pyarrow', 'torch', 'h5py', 'distributed'} & {*sys.modules})"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, env=ENVIRONMENT
    )
    assert done.stdout == "set()\n", done.stderr


BASH = """\
source {script}
complete_words() {{
    COMP_WORDS=("$@"); COMP_CWORD=$(($# - 1)); COMPREPLY=()
    _shtab_lae_sim lae-sim "${{COMP_WORDS[COMP_CWORD]}}" "${{COMP_WORDS[COMP_CWORD-1]}}"
    echo "${{COMPREPLY[@]}}"
}}
complete_words lae-sim re
complete_words lae-sim replay --sig
complete_words lae-sim replay nano
complete_words lae-sim study my
complete_words lae-sim profile --mode re
complete_words lae-sim replay nano.parquet --timing jet
"""


@pytest.mark.skipif(shutil.which("bash") is None, reason="there is no bash")
def test_bash_completes_commands_options_choices_and_files(tmp_path):
    for name in ("nano.parquet", "jetson.parquet", "my.toml"):
        (tmp_path / name).touch()
    script = tmp_path / "completion.bash"
    script.write_text(run_here("--print-completion", "bash").stdout)
    done = subprocess.run(
        ["bash", "-c", BASH.format(script=script)], capture_output=True, text=True, cwd=tmp_path
    )
    assert done.stdout.splitlines() == [
        "render replay",
        "--sigma --sigma-grid",
        "nano.parquet",
        "my.toml",
        "real-time",
        "jetson.parquet",
    ], done.stderr


def test_a_shell_that_is_not_known_is_refused_in_one_line():
    done = run_process("--print-completion", "fish")
    assert done.returncode == 2
    assert "--print-completion: invalid choice: 'fish'" in done.stderr
    assert len(done.stderr.splitlines()) == 1
    assert "#compdef lae-sim" in run_here("--print-completion", "zsh").stdout
