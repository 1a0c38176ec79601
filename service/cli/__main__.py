"""``python -m service.cli`` is ``smsr``."""

from __future__ import annotations

from service.cli import main

main()
