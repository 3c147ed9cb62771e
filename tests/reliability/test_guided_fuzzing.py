"""Parsers of bytes under a fuzzer that is steered by what they do with them (guided.py); needs the extra `fuzzing`."""

import importlib.util
import os
import re
import subprocess
import sys
import zlib
from pathlib import Path

import pytest
from builders import PYTHONPATH
from builders.reliability.ledger import count

PARSERS = (
    "binary PLY mesh", "text PLY mesh", "Gaussians in PLY", "DeepMIMO in MATLAB's format", "YAML", "JSON", "queries", "walls",
)  # fmt: skip
SECONDS = 60
"""Of a parser."""
LIMITS = ["-timeout=5", "-rss_limit_mb=4096", "-max_len=20000"]


@pytest.mark.slow
@pytest.mark.skipif(importlib.util.find_spec("atheris") is None, reason="atheris (extra `fuzzing`) is not installed")
@pytest.mark.parametrize("name", PARSERS)
def test_no_bytes_break_a_parser(name, tmp_path):
    seed = (int(os.environ["WBGS_TEST_SEED"]) ^ zlib.crc32(name.encode())) % 2**31 + 1
    words = [
        sys.executable,
        Path(PYTHONPATH.split(os.pathsep)[0]) / "builders" / "reliability" / "guided.py",
        name,
        f"-max_total_time={SECONDS}",
        f"-seed={seed}",
        *LIMITS,
    ]
    environment = os.environ | {"PYTHONPATH": PYTHONPATH}
    done = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, check=False, env=environment)
    assert done.returncode == 0, done.stderr[-3000:]
    tried = re.search(r"Done (\d+) runs", done.stderr)
    assert tried and int(tried[1]) > 1000, done.stderr[-500:]
    count("inputs steered by coverage", name, int(tried[1]))
