"""What tests are made with: rooms, spectra, fields, runs, damaged files and the programs that write others."""

import os
from pathlib import Path

PYTHONPATH = os.pathsep.join(map(str, Path(__file__).parents[1:3]))
"""Where processes that tests start find these modules and the library's."""
