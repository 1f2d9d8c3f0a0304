"""What a process that starts Dask workers loads first: it then forks them from a process that has done the imports."""

from multiprocessing import forkserver

forkserver.set_forkserver_preload(["distributed", "test_sweeps"])
forkserver.ensure_running()
