"""Run measurements, record them as JSON, and fill the tables of the documentation from the records.

``python tools/bench.py substep``    one elastic substep; writes docs/results/substep_<device>.json
``python tools/bench.py speed``      rollouts, batches and frames; writes docs/results/speed_<device>.json
``python tools/bench.py sim``        the main job end to end; writes docs/results/sim_<device>.json
``python tools/bench.py accuracy``   errors against exact solutions; writes docs/results/accuracy_<device>.json
``python tools/bench.py pareto``     speed against error; writes docs/results/pareto_<device>.json
``python tools/bench.py points``     error and time against points per cell; writes docs/results/points_<device>.json
``python tools/bench.py backward``   cost of gradients in `total`; writes docs/results/backward_<device>.json
``python tools/bench.py gradients``  memory of gradients, and tools/fit_flag.py; writes docs/results/gradients_cpu.json
``python tools/bench.py train``      training on a capture and a generated flag; writes docs/results/train_<device>.json
``python tools/bench.py surfaces``   tilts of trained normals; writes docs/results/surfaces_<device>.json
``python tools/bench.py flags``      the flag benchmark; writes docs/results/flags_<device>.json
``python tools/bench.py pins``       how a held edge is modelled; writes docs/results/pins_<device>.json
``python tools/bench.py contact``    cost of contact, and gaps; writes docs/results/contact_<device>.json
``python tools/bench.py fit``        wind and material from videos; writes docs/results/fit_<device>.json
``python tools/bench.py soft``       the same for a soft body by Newton; writes docs/results/soft_<device>.json
``python tools/bench.py gallery``    the paper's scenes; writes docs/results/gallery_<device>.json and pictures
``python tools/bench.py previews``   announced and taken times of runs; writes docs/results/previews_<device>.json
``python tools/bench.py area``       areas that the wind can reach; writes docs/results/area_cpu.json
``python tools/bench.py web``        films for the web in a browser; writes docs/results/web_<device>.json
``python tools/bench.py winds``      winds that differ from place to place; writes docs/results/winds_<device>.json
``python tools/bench.py pages``      fills the slots of docs/benchmarks.md, validation.md, training.md and so on
``python tools/bench.py pictures``   a strip of frames of a finished run
``python tools/bench.py film``       the README's moving picture from finished runs
"""

import os

os.environ.setdefault("GOMP_SPINCOUNT", "3000")  # as in tools/sim.py; must be set before torch is imported

from bench.command import main  # the folder next to this file

if __name__ == "__main__":
    main(__doc__ or "")
