"""`mpipic ARGS` where some ranks may write no file longer than some bytes: limited_helpers.py BYTES RANKS ARGS...

As on a full disk, at a place that a test can choose; MPI and the compiled loops, which keep files of their own,
begin before.
"""

import resource
import sys

import mpipic.kernels  # noqa: F401
from mpipic.runtime import start

comm = start()
if str(comm.rank) in sys.argv[2].split(","):
    resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[1]),) * 2)
sys.argv[1:] = sys.argv[3:]

from mpipic.cli import main  # noqa: E402

main()
