"""Fill the generated parts of README.md: what stands between ``<!-- name: command -->`` marks.

    .venv/bin/python scripts/fill_readme.py [options] [accuracy]

Without names all parts are filled; the accuracy table needs the evaluation sets (SMSR_DATA or
../shared/data) and a quiet machine, since it holds times.
"""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
README = ROOT / "README.md"
MARKS = re.compile(r"(<!-- (\w+): smsr (.*?) -->\n).*?(<!-- /\2 -->)", re.DOTALL)


def output(command: str) -> str:
    """Run an smsr command and return what it prints."""
    data = os.environ.get("SMSR_DATA", str(ROOT.parent / "shared" / "data"))
    return subprocess.run(
        [sys.executable, "-m", "service.cli", *shlex.split(command)],
        cwd=ROOT,
        env=os.environ | {"SMSR_DATA": data},
        stdout=subprocess.PIPE,
        text=True,
        check=True,
    ).stdout


def main() -> None:
    """Fill the parts named on the command line, or all."""
    wanted = set(sys.argv[1:])

    def filled(part: re.Match[str]) -> str:
        mark, name, command, end = part.groups()
        if wanted and name not in wanted:
            return part.group()
        return f"{mark}{output(command).strip()}\n\n{end}"

    README.write_text(MARKS.sub(filled, README.read_text(encoding="utf-8")), encoding="utf-8")


if __name__ == "__main__":
    main()
