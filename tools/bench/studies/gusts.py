"""Records of a sonic anemometer above a canopy (20 Hz, 15 minutes), beside the generated turbulence and on a tree.

Copy the TOA5 files of ``usda-ars-ussl/fluxpart`` (CC0) into ``outputs/gusts``.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from scipy.signal import welch

from bench.problems.trees import in_gusts
from bench.runner import ROOT, Row, study
from gaussian_swaying.wind.turbulence import sheared_variances, turbulence_box
from gaussian_swaying.wind.wind_files import read_anemometer

RECORDS = ROOT / "outputs" / "gusts"
WAYS = [{"spectrum": "von_karman", "gamma": 0.0}, {"spectrum": "kaimal", "gamma": 0.0},
        *({"spectrum": "von_karman", "gamma": gamma} for gamma in (1.0, 2.0, 3.0, 3.9))]  # fmt: skip
CELLS, FACTOR, SEGMENTS, BANDS = (512, 64, 64), 1.5, 16, 12
"""Cells of the box, each an eighth of the length; how far spectra may be apart; parts of a record whose spectra are
averaged; bands of frequencies."""
LENGTHS = (0.1, 0.15, 0.2, 0.25, 0.3, 0.4, 0.5, 0.6, 0.8, 1.0, 1.3)
"""Lengths of the turbulence that are tried, in measured ones: that of Mann's is the one without the shear."""


def cases(device: str) -> list[Row]:
    """Every record with every spectrum."""
    del device
    return [{"record": path.name, **way} for path in sorted(RECORDS.glob("*.dat")) for way in WAYS]


def along_the_wind(record: str) -> tuple[float, np.ndarray, float]:
    """Rate [Hz], fluctuations along, across and up (T, 3) and mean speed [m/s] of a record."""
    times, rows = read_anemometer(RECORDS / record)
    flows = np.array(rows)
    mean = flows.mean(0)
    speed = float(np.linalg.norm(mean))
    first = mean / speed
    across = np.cross([0.0, 0.0, 1.0], first)
    across /= np.linalg.norm(across)
    turned = np.stack([first, across, np.cross(first, across)])
    return 1 / float(np.median(np.diff(times))), (flows - mean) @ turned.T, speed


def integral_time(values: np.ndarray, rate: float) -> float:
    """Integral of the correlation up to its first zero [s]."""
    power = np.abs(np.fft.rfft(values, 2 * len(values))) ** 2
    correlation = np.fft.irfft(power)[: len(values)]
    return float(correlation[: np.argmax(correlation <= 0)].sum() / correlation[0] / rate)


def share_of(ratio: np.ndarray) -> float:
    """The share of ratios within :data:`FACTOR`."""
    return float((np.abs(np.log(ratio)) <= np.log(FACTOR)).mean())


@study("gusts", cases)
def gusts(record: str, spectrum: str, gamma: float) -> Row:
    """The share of bands in which each component has its spectrum within a factor, for the length that suits best."""
    rate, flows, speed = along_the_wind(record)
    length = speed * integral_time(flows[:, 0], rate)
    segment = len(flows) // SEGMENTS
    measured = welch(flows, rate, nperseg=segment, axis=0)
    best: Row = {}
    for factor in LENGTHS:
        side = factor * length / 8
        box = turbulence_box(CELLS, [side] * 3, factor * length, spectrum, gamma, seed=1).numpy()
        box *= flows[:, 0].std() / sheared_variances(gamma)[0] ** 0.5
        made = welch(box, speed / side, nperseg=CELLS[0], window="boxcar", axis=0)
        made = made[0], made[1].mean((1, 2))
        edges = np.geomspace(2 * rate / segment, min(0.2 * speed / side, 0.2 * rate), BANDS + 1)
        bands = [[(found >= low) & (found < high) for low, high in pairwise(edges)] for found, _ in (measured, made)]
        ratio = np.array(
            [measured[1][a].mean(0) / made[1][b].mean(0) for a, b in zip(*bands, strict=True) if a.any() and b.any()]
        )
        if not best or share_of(ratio) > best["within"]:
            best = {"within": share_of(ratio), "length_of_measured": factor, "band_hz": edges[[0, -1]].tolist()}
            best |= {
                f"within_{name}": share_of(part) for name, part in zip(("along", "across", "up"), ratio.T, strict=True)
            }
            best |= {"ratio": ratio.round(2).tolist()}
    return {"speed_m_s": speed, "deviation_m_s": flows.std(0).tolist(), "length_m": length} | best


def records(device: str) -> list[Row]:
    """Every record."""
    del device
    return [
        {"record": path.name, "seconds": 300.0, "leaf_area": 30.0, "dx": 0.5} for path in sorted(RECORDS.glob("*.dat"))
    ]


@study("tree_gusts", records)
def tree_gusts(record: str, seconds: float, leaf_area: float, dx: float) -> Row:
    """How a tree of 17 m sways in a record: mean, deviation and spectrum by the solver over those of its first mode."""
    rate, flows, speed = along_the_wind(record)
    count = round(seconds * rate)
    moved = in_gusts(flows[:count] + speed * np.eye(3)[0], rate, leaf_area, dx=dx)
    late = {name: values[round(30 * rate) :] for name, values in moved.items()}  # it was at rest
    spectra = {name: welch(values, rate, nperseg=round(50 * rate)) for name, values in late.items()}
    edges = 0.04 * 2.0 ** np.arange(6)
    bands = [(spectra["found"][0] >= low) & (spectra["found"][0] < high) for low, high in pairwise(edges)]
    numbers: Row = {"mean_m": float(late["found"].mean()), "deviation_m": float(late["found"].std())}
    for name in ("mode", "linear", "own"):
        ratio = [spectra["found"][1][band].mean() / spectra[name][1][band].mean() for band in bands]
        numbers[name] = {
            "mean": float(late["found"].mean() / late[name].mean()),
            "deviation": float(late["found"].std() / late[name].std()),
            "correlation": float(np.corrcoef(late["found"], late[name])[0, 1]),
            "spectrum": np.round(ratio, 3).tolist(),
        }
    return numbers | {"edges_hz": edges.round(3).tolist()}
