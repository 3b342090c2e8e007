import pytest
import yaml
from shared import refused

from gaussian_swaying._yaml_limits import check_yaml, read_fields
from gaussian_swaying.cli.simulate import main


def laughs(levels):
    lines = ["a0: &a0 [lol, lol, lol, lol, lol, lol, lol, lol, lol]"]
    lines += [f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]" for i in range(1, levels)]
    return "\n".join(lines)


BAD = {
    "laughs": (laughs(10), "values, aliases included"),
    "cyclic": ("wind: &w {flow: [1, 2, 3], again: *w}", "too large"),
    "deep": ("[" * 100_000, "64 levels"),
    "many": ("edits:\n" + "- {time: 1.0, E: 2.0}\n" * 20_000, "too large"),
    "large": ("output: " + "x" * (1 << 20), "too long"),
}


@pytest.mark.parametrize(("text", "words"), BAD.values(), ids=BAD)
def test_what_is_too_much_is_refused(text, words, tmp_path, capsys):
    with pytest.raises(ValueError, match=words):
        check_yaml(text)
    (tmp_path / "bad.yaml").write_text(text)
    refused(main, ["--config", str(tmp_path / "bad.yaml")], capsys)


def test_aliases_that_do_no_harm_are_kept():
    text = "a: &a {E: 1.0}\nb: [*a, *a]\nc: &c 5\nd: *c\n" + "# as long as it takes"
    assert check_yaml(text) == text
    assert yaml.safe_load(laughs(4))["a3"][0][0][0][0] == "lol"
    assert check_yaml(laughs(4))


def test_a_group_without_fields(capsys):
    refused(main, ["--config", "wind: [1, 2]", "--frames", "2"], capsys, "Expected `wind` to contain fields")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (b"frames: [1", "fields.yaml is not valid YAML"),
        (b"[frames]", "to have the fields frames, output, but got"),
        (b"", "to have the fields frames, output, but got None"),
        (b"frame: 3", "unknown field `frame`: use frames, output"),
        ("output: Blüte".encode("latin-1"), "fields.yaml is not UTF-8 text"),
    ],
)
def test_a_file_of_known_fields(text, words, tmp_path):
    path = tmp_path / "fields.yaml"
    path.write_bytes(text)
    with pytest.raises(ValueError, match=words):
        read_fields(path, "the plan", ("frames", "output"))
    path.write_text("frames: 3")
    assert read_fields(path, "the plan", ("frames", "output")) == {"frames": 3}
    with pytest.raises(FileNotFoundError, match="the path of the plan"):
        read_fields(tmp_path / "none.yaml", "the plan", ("frames",))
