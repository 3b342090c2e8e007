import pytest
import torch
from shared import beyond, in_both, near, peak, up_to, user_warning, value_error

from gaussian_swaying import (
    AeroForce,
    Edit,
    GaussianCloud,
    Material,
    MPMSolver,
    PinnedRegion,
    Recorder,
    Simulation,
    SpatialWind,
    WindField,
    load_trajectory,
    write_ply,
)
from gaussian_swaying.scenes import FlagScene

POLE = up_to(x=0.11)
SMALL = {"hold": POLE, "material": Material(E=3e3, density=30.0), "wind": [6.0, 1.5, 0.0], "device": "cpu"}


def _flag(**changes):
    return Simulation(FlagScene(spacing=0.1), **(SMALL | changes))


def test_a_file_its_gaussians_and_what_made_them_are_the_same(tmp_path):
    source = FlagScene(spacing=0.1)
    write_ply(tmp_path / "flag.ply", source.generate())
    ends = []
    for scene in (source, source.generate(), tmp_path / "flag.ply", str(tmp_path / "flag.ply")):
        *_, last = Simulation(scene, **SMALL).frames(3)
        ends.append(last.state.position)
    assert isinstance(source.generate(), GaussianCloud)
    assert all(torch.equal(end, ends[0]) for end in ends)
    assert peak(ends[0] - _flag().start().position) > 1e-3


def test_frames_are_those_of_a_run(tmp_path):
    """Also with an edit between two frames, and a second time from the same object."""
    edits = [Edit(time=0.08, E=3e4, color=[1.0, 0.0, 0.0]), Edit(time=0.04, density=60.0)]
    simulation = _flag(edits=edits)
    simulation.run(tmp_path / "run", 5, progress=False, recorder=Recorder(renders=()))
    for _ in range(2):
        for frame in simulation.frames(5):
            position, F = load_trajectory(tmp_path / "run/trajectory.npz", frame.index)
            now, strain = simulation.scene.surface(frame.state)
            assert torch.equal(now, position)
            near(F.float(), strain, 2e-3)  # kept as float16
        assert float(simulation.solver.points.youngs_modulus[0]) == 3e4
    *_, plain = _flag().frames(5)
    assert not torch.equal(plain.state.position, frame.state.position)


def test_another_wind_holds_from_the_next_frame_on():
    simulation, ends = _flag(), []
    for frame in simulation.frames(4):
        if frame.index == 1:
            simulation.wind, middle = WindField([0.0, -8.0, 0.0]), frame.state
    other = _flag(wind=[0.0, -8.0, 0.0])
    other.start()
    for _ in range(2):
        middle, _ = other.advance(middle)
    assert torch.equal(middle.position, frame.state.position)
    for aero in (AeroForce(C_D=0.0, C_F=0.0, C_L=0.0), AeroForce()):  # without effect, and with it again
        simulation.aero = aero
        ends.append(len(simulation.forces))
    assert ends == [0, 1]


def test_numbers_change_by_their_names_between_frames():
    simulation, other = _flag(), _flag(material=Material(E=3e4, density=30.0), wind=[0.0, 5.0, 0.0])
    for frame in simulation.frames(4):
        if frame.index == 1:
            middle = frame.state
            simulation.change("material.E", 3e4)
            simulation.change({"wind.azimuth": 90.0, "wind.speed": 5.0})
    other.start()
    for _ in range(2):
        middle, _ = other.advance(middle)
    near(middle.position, frame.state.position, 1e-6)


def test_several_pins():
    """Regions and pins; what no pin holds falls, and a run says so before it starts."""
    ends = (POLE, PinnedRegion(beyond(x=1.09)))
    simulation = _flag(hold=list(ends))
    *_, last = simulation.frames(3)
    moved = (last.state.position - simulation.scene.points.position).norm(dim=-1)
    x = simulation.scene.points.position[:, 0]
    assert moved[(x == x.min()) | (x == x.max())].max() < 0.05 * moved.max()
    with pytest.raises(TypeError, match="`hold` to be a Region or a PinnedRegion or a PinnedPoints or a list of"):
        _flag(hold=[POLE, "foot"])
    (guessed,) = _flag(hold="auto").solver.boundaries
    assert repr(guessed.region) == repr(_flag().solver.boundaries[0].region).replace("0.11", "0.35")  # 1.5 cells
    with value_error("`hold` to be one of auto"):
        _flag(hold="foot")
    with user_warning("Nothing holds the object.*so it falls"):
        next(_flag(hold=None).frames(1))


def test_what_is_printed_tells_what_it_is():
    simulation = _flag(hold=[PinnedRegion(POLE, kind="clamp")])
    held = "PinnedRegion(region=Box(min=[None, None, None], max=[0.11, None, None]), kind='clamp')"
    assert repr(simulation) == (
        "Simulation(96 Gaussians of which 96 move by 96 points, Material(E=3000, density=30), "
        f"MPMSolver(dx=0.2, gravity=[0, 0, 0], boundaries=[{held}]), WindField(flow=[6, 1.5, 0]), cpu)"
    )
    frame = next(simulation.frames(1))
    assert repr(frame) == "Frame(0, time=0)"
    for part in (frame.state, frame.gaussians, simulation.model, simulation.painter, simulation.solver.points):
        assert "96, 3" in repr(part) or "96 Gaussians" in repr(part)
        assert len(repr(part)) < 1000


class Shear(SpatialWind):
    def forward(self, time, position):
        return position[..., :1] * position.new_tensor([0.0, 5.0, 0.0])


def test_a_wind_that_depends_on_the_place():
    simulation = _flag(wind=Shear())
    *_, last = simulation.frames(5)
    moved = (last.state.position - simulation.scene.points.position)[:, 1]
    tip, pole = (moved[simulation.scene.points.position[:, 0] * side > 0.3].mean() for side in (1, -1))
    assert float(tip) > 0.01  # x > 0: the air goes to +y there, and to -y on the other side
    assert float(pole) < 0


def test_a_function_is_a_force_too():
    simulation = _flag(wind=None, forces=[lambda state: torch.tensor([0.0, 0.01, 0.0]).expand_as(state.velocity)])
    *_, last = simulation.frames(3)
    assert (last.state.position - simulation.scene.points.position)[:, 1].mean() > 1e-4


@in_both
def test_runs_in_one_rollout_end_as_each_alone(formulation):
    """They differ in wind and material; the substep of the rollout is the shortest, so all have a fixed one."""
    pins = [PinnedRegion(POLE)]
    solver = MPMSolver(0.2, formulation, substep=2e-3, boundaries=pins, transfer="torch")
    first = _flag(hold=None, solver=solver, dtype="float64")
    members = [first, first.variant({"wind.speed": 9.0}), first.variant({"material.E": 2e4, "wind.azimuth": 50.0})]
    batch = first.batch([member.model for member in members])
    state = batch.start()
    for _ in range(3):
        state, _ = batch.advance(state)
    ends = []
    for member in members:
        alone = member.start()
        for _ in range(3):
            alone, _ = member.advance(alone)
        ends.append(alone.position)
    # forces are added in another order, some ten times in each of 60 substeps
    near(state.position, torch.stack(ends), 1e-12)
    assert all(float(peak(ends[k] - ends[0])) > 1e-3 for k in (1, 2))
