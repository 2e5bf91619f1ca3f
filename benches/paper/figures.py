"""Numbers from the method's paper, and of its authors' program, for comparison with ours.

The paper: Bhattacharya, Gao and Bargteil, *A Level-set Method for Skinning Animated Particle Data*, IEEE TVCG
2015. Its Fig. 18 to 20 are plots without numbers; Table 2 has the numbers for the speedup of threads.
"""

MACHINE = "two Intel Xeon X5650, 12 cores in all, 2.8 GHz, 48 GB"
CORES = 12

# Table 1: the examples of Fig. 14, averages over their frames. Seconds without reading and writing. "Basic"
# uses a dense grid and 10 000 explicit steps; "OpenVDB" uses a sparse grid and 5 implicit steps.
EXAMPLES = ["FLIP, 217 K", "38 K", "SPH, 52 K", "elasto-plastic SPH, 40 K"]
EXPLICIT = {
    "total": (2339.1, 2319.6, 2504.7, 946.2),
    "rasterization": (11.5, 1.5, 3.7, 0.3),
    "fast sweeping": (18.4, 24.6, 35.8, 10.2),
    "operator": (1486.1, 1430.2, 1491.5, 542.9),
    "slope of φ": (468.7, 466.2, 497.4, 203.6),
    "memory, GB": (0.79, 0.53, 0.7, 0.32),
}
IMPLICIT = {
    "total": (79.5, 74.9, 72.8, 14.5),
    "rasterization": (11.9, 0.7, 2.7, 0.8),
    "fast sweeping": (3.4, 1.5, 1.9, 1.1),
    "operator": (30.9, 37.6, 33.1, 6.1),
    "vectors of CG": (17.2, 18.9, 18.8, 2.9),
    "voxels on and off": (13.7, 13.4, 13.2, 3),
    "constraints": (2.1, 2.3, 2.3, 0.5),
    "memory, GB": (0.82, 0.26, 0.46, 0.18),
    "CG iterations": (969, 1940, 1301, 758),
    "CPU, %": (1113, 1158, 1124, 1110),
}

# Table 2: number of concurrent processes, threads of each, minutes for all jobs. The paper's text says 120
# jobs and the caption 12; the seconds of a job in Table 3 imply 120.
JOBS = 120
PROCESSES = [(12, 1, 212), (6, 2, 216), (4, 3, 224), (3, 4, 231), (2, 6, 249), (1, 12, 283)]

# Table 3: number of particles of the dragon; total seconds, and seconds of rasterization alone; CPU in %,
# memory in GB, iterations of conjugate gradients (CG).
DRAGONS = [
    (0.603e6, 25.5, 3.7, 1089, 0.35, 938),
    (4.82e6, 141.2, 25.3, 1125, 1.1, 1181),
    (38.6e6, 971.2, 196.1, 1138, 4.4, 1965),
    (309e6, 6450.2, 1551.9, 1135, 28, 2144),
]

# The authors' published program, built with OpenVDB 10: whole processes on two threads, with 5 implicit steps
# or 500 explicit steps. In the explicit steps it never computes the slope of φ. The seconds of the implicit
# steps are in `peers`.
PROGRAM_MACHINE = "AMD EPYC (Zen 5), 2 cores"
PROGRAM_EXPLICIT = {
    "dam break 9": 2.04,
    "double dam break 26": 5.31,
    "dam break 23": 8.04,
    "Hilbert curve": 16.11,
}
# The dragon at h = spacing, by number of particles: seconds and GB with implicit steps; for the smallest
# dragon, also the seconds with explicit steps.
PROGRAM_DRAGONS = {0.603e6: (64.54, 0.211), 4.82e6: (350.51, 0.874)}
PROGRAM_DRAGON_EXPLICIT = 21.28


def speedups():
    """Pairs of the number of threads and the speedup, from Table 2."""
    alone = CORES * next(minutes for processes, _, minutes in PROCESSES if processes == CORES)
    return [(threads, alone / (processes * minutes)) for processes, threads, minutes in PROCESSES]


def job_seconds(processes, minutes):
    """The minutes of one job of Table 2 while this many processes run at once."""
    return 60 * minutes * processes / JOBS
