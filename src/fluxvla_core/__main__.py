"""``python -m fluxvla_core`` is ``fluxvla``; ``torchrun -m fluxvla_core run …`` starts ranks."""

import sys

from fluxvla_core.cli import ranks
from fluxvla_core.cli.main import main

if __name__ == "__main__":
    code = main()
    if ranks.world_size() is not None:
        ranks.exit_now(code)
    sys.exit(code)
