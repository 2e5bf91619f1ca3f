"""Runs one program and prints its costs as JSON: seconds, CPU seconds, peak memory in bytes, exit status.

Until a child process executes its program, the system counts its peak memory as that of its parent. So a
separate process runs this script for each measurement, with Python without its site packages. The script
imports little and uses 8 MB, less than any measured program.
"""

import os
import sys
import time

start = time.perf_counter()
quiet = [(os.POSIX_SPAWN_OPEN, 1, os.devnull, os.O_WRONLY, 0)]
process = os.posix_spawnp(sys.argv[1], sys.argv[1:], os.environ, file_actions=quiet)
_, status, usage = os.wait4(process, 0)
seconds = time.perf_counter() - start
size_bytes = usage.ru_maxrss * (1 if sys.platform == "darwin" else 1024)
print([seconds, usage.ru_utime + usage.ru_stime, size_bytes, os.waitstatus_to_exitcode(status)])
