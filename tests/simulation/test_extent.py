import torch
from shared import user_warning, value_error

from gaussian_swaying.simulation.body import check_density, check_extent, coarse, narrow


def cube(count=1000):
    return torch.rand(count, 3)


def test_usual_objects_pass(recwarn):
    check_extent(cube(), 1.0, 0.05)
    check_extent(torch.cat([cube(), torch.tensor([[3.0, 0.0, 0.0]])]), 1.0, 0.05)
    check_extent(torch.tensor([[0.0, 0, 0], [1e6, 0, 0]]), 1.0, 1000.0)  # two may be meant so
    check_extent(torch.zeros(100, 3) + torch.linspace(0, 1, 100)[:, None], 1.0, 0.05)
    assert not recwarn.list


def test_a_stray_gaussian():
    stray = torch.cat([cube(), torch.tensor([[0.0, 1e10, 0.0]])])
    with value_error(r"Gaussian 1000 lies at \[0.0, 10000000000.0, 0.0\].*`scene.region`"):
        check_extent(stray, 1e-10, 0.05)
    with value_error("Gaussian 7000 lies"):
        check_extent(stray, 1e-10, 0.05, torch.arange(1001) * 7)
    with user_warning("Gaussian 1000 lies at"):
        check_extent(torch.cat([cube(), torch.tensor([[40.0, 0.0, 0.0]])]), 1.0, 0.05)


def test_an_object_smaller_than_the_grid():
    with value_error(r"0\.00\d+ cells of `solver.dx` = 1000 m.*lower `solver.dx` to about 0.042"):
        check_extent(cube(), 1.0, 1000.0)
    with user_warning("2 cells of `solver.dx` = 0.5 m"):
        check_extent(cube(), 1.0, 0.5)


def test_a_bent_tube_of_few_cells_across_says_so():
    turn, along = torch.meshgrid(torch.arange(8) * torch.pi / 4, torch.arange(50) * 0.01, indexing="ij")
    tube = torch.stack([0.02 * turn.cos(), 0.02 * turn.sin(), along], dim=-1).reshape(-1, 3)
    tilted = tube @ torch.linalg.qr(torch.tensor([[1.0, 2, 3], [0, 1, 4], [5, 6, 0]]))[0]
    (said,) = narrow(tube, 0.02, 0.3)
    assert "0.04 m across, 2 cells of `solver.dx` = 0.02 m" in said
    assert "lower `solver.dx` to about 0.0067 m, and set `scene.filling`" in said
    assert len(narrow(tilted, 0.02, 0.3)) == 1
    assert narrow(tube, 0.009, 0.3) == narrow(tube, 0.02, 0.1) == narrow(tube[:15], 0.02, 0.3) == []
    assert narrow(tube * torch.tensor([1.0, 0.3, 1.0]), 0.02, 0.3) == []
    assert narrow(tube * torch.tensor([0.0, 0.0, 1.0]), 0.02, 0.3) == []


def test_a_run_on_a_coarse_grid_says_so():
    assert coarse(1.0, 0.1) == coarse(1.0, 0.5) == []
    assert "9 cells of `solver.dx` = 0.1 m" in coarse(0.9, 0.1)[0]
    assert coarse(0.9, 0.1)[0].endswith("`scene.metres_per_unit`.")


def test_a_grid_too_fine_for_the_gaussians(recwarn):
    steps = 0.1 * torch.arange(10.0)
    sheet = torch.cartesian_prod(steps, steps, torch.zeros(1))
    check_density(sheet, 1.0, 0.2)
    check_density(sheet[:8], 1.0, 0.1)  # so few may be meant so
    assert not recwarn.list
    with user_warning(r"0.1 m apart, 1 cells.*raise `solver.dx` to about 0.2 m"):
        check_density(sheet, 1.0, 0.1)
