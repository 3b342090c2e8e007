"""Parts of a plant that need nodes of their own on a grid, as they lie beside what they are not attached to."""

from __future__ import annotations

import torch
from torch import Tensor

from gaussian_swaying.gaussians.connectivity import pieces
from gaussian_swaying.geometry.groups import equal_rows, joined
from gaussian_swaying.simulation.body import SimulatedScene

REACH = 3  # cells that a node reaches
ENOUGH = 0.1  # share of the Gaussians that lie beside something else, from which on nodes of their own help


def pieces_of_nodes(scene: SimulatedScene, dx: float) -> tuple[Tensor, Tensor, float]:
    """Pieces of what is connected along the surface within the reach of a node.

    Args:
        scene: A scene of ``scene.connected: surface``.
        dx: Grid spacing [m].

    Returns:
        Cell and piece of each simulated Gaussian, shape (M,) each, where a cell is as large as the reach of a node, and
        the share of them that a node would join to something else.
    """
    assert scene.pairs is not None
    side = REACH * dx / scene.frame.metres_per_unit
    cell = equal_rows((scene.model.means.detach().cpu().double()[scene.simulated.cpu()] / side).floor())
    piece, several = pieces(cell, scene.pairs)
    return cell, piece, float(several.double().mean())


def why_apart(scene: SimulatedScene, dx: float, held: Tensor) -> str | None:
    """The reason for nodes of their own, in words; None if parts should share them.

    They should not share them if much lies beside what it is not attached to, and all hangs together with what is held:
    what does not would fall, though a grid may hold it.

    Args:
        scene: A scene of ``scene.connected: surface``.
        dx: Grid spacing [m].
        held: Which Gaussians are held, bool, shape (N,).
    """
    assert scene.pairs is not None
    piece = joined(len(scene.simulated), scene.pairs.T)
    hangs = torch.isin(piece, piece[held[scene.simulated.cpu()]])
    beside = pieces_of_nodes(scene, dx)[2]
    if beside < ENOUGH or not bool(hangs.all()):
        return None
    return f"{100 * beside:.0f} % lie within reach of a node beside what they are not attached to"
