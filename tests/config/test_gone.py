import pytest
from shared import value_error

from gaussian_swaying.config.gone import GONE, refuse_gone
from gaussian_swaying.simulation.simulation import Simulation


@pytest.mark.parametrize("name", GONE)
def test_a_name_that_is_gone_is_refused_with_the_new_one(name):
    first, _, field = name.partition(".")
    found = {first: {field: 1}} if first.islower() else {"class_path": f"a.b.{first}", "init_args": {field: 1}}
    with value_error(rf"`{name}` is gone: use "):
        refuse_gone({"part": [found]} if first[0].isupper() else found)


@pytest.mark.parametrize("given", ["VaseScene", "gaussian_swaying.scenes.VaseScene"])
def test_a_file_and_an_option_with_such_a_name_are_refused(given, tmp_path):
    path = tmp_path / "old.yaml"
    path.write_text(f"scene: {{generator: {{class_path: {given}, init_args: {{flowers: 3}}}}}}\n")
    with value_error("`VaseScene` is gone: use DemoScene with `kind: vase`"):
        Simulation.from_yaml(path)
    with pytest.raises(Exception, match="`VaseScene` is gone"):
        Simulation.parser().parse_args([f"--scene.generator={given}"])
    with value_error("`recorder.images` is gone: use `recorder.renders`"):
        Simulation.parser().parse_args(["--recorder.images", "false"])
