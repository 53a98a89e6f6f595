"""`jaxreg evaluate`: what it prints and writes, and which options it refuses."""

import dataclasses
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxreg.cli import evaluate, options
from jaxreg.config import Config, DataConfig, ModelConfig, PairConfig, load_config
from jaxreg.data.batches import true_transforms
from jaxreg.evaluation import methods, score
from jaxreg.types import RigidTransform
from jaxreg.view import pictures
from jaxreg.weights.checkpoint import open_run

pytestmark = pytest.mark.float32

ROOT = Path(__file__).parents[2]


def script(name, *arguments):
    command = [sys.executable, str(ROOT / name), *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=300)


def test_the_command_prints_a_table_and_writes_the_figures(tmp_path):
    out = tmp_path / "r.json"
    toml = tmp_path / "c.toml"
    toml.write_text('[data]\nname = "shapes"\ntest_shapes = 2\n[pairs]\npoints = 32\nkept = 24\n')
    done = script("evaluate.py", toml, "--method", "identity", "--json", out)
    assert done.returncode == 0, done.stderr
    assert "MAE(R) deg" in done.stdout
    figures = json.loads(out.read_text())
    names = {"method", "config", "dataset", "pairs", "mae_r_deg", "mae_t", "mie_r_deg"}
    names |= {"mie_r_deg_float32_acos", "mie_t", "median_rre_deg", "median_rte"}
    assert names | {"recall_1deg", "recall_5deg", "seconds_per_pair"} <= set(figures)


@pytest.fixture(scope="module")
def config():
    """The test pairs of `toml`, as far as they are the same for every network."""
    return Config(
        data=DataConfig(name="shapes", test_shapes=3), test_pairs=PairConfig(points=32, kept=24)
    )


@pytest.fixture
def toml(tmp_path):
    path = tmp_path / "c.toml"
    path.write_text(
        'weights = "modelnet40"\n[data]\nname = "shapes"\ntest_shapes = 3\n'
        "[pairs]\npoints = 32\nkept = 24\n[model]\nn_inliers = 16\n"
    )
    return path


@pytest.fixture
def command(toml, monkeypatch, capsys):
    """evaluate.py in this process and in the folder of its files: status, what it prints, its error."""
    monkeypatch.chdir(toml.parent)

    def run(*options):
        status = 0
        try:
            status = evaluate.main(["c.toml", *options])
        except SystemExit as end:
            status = end.code
        return status, *capsys.readouterr()

    return run


@pytest.fixture
def asked(monkeypatch):
    """The configurations that are to be evaluated; none is."""
    configs = []

    def evaluate_not(config, **_):
        configs.append(config)
        raise ValueError("not here")

    monkeypatch.setattr(score, "evaluate", evaluate_not)
    return configs


@pytest.mark.parametrize("refine", [(), ("--refine", "icp")])
def test_the_picture_shows_the_first_pair_as_it_was_scored(config, command, monkeypatch, refine):
    drawn, loads = [], []
    load = score.load_shapes
    monkeypatch.setattr(score, "load_shapes", lambda *a, **k: loads.append(a) or load(*a, **k))

    def draw(*arguments, truth):
        drawn.append((*arguments, truth))
        arguments[3].touch()

    monkeypatch.setattr(pictures, "plot_pair", draw)
    turns = Rotation.from_euler("z", [[3], [4], [5]], degrees=True).as_matrix().astype(np.float32)
    np.savez("mine.npz", rotation=turns, translation=np.ones((3, 3), np.float32))
    options = ("--transforms", "mine.npz", *refine, "--picture", "first.png")
    status, _, error = command(*options, "--save-transforms", "scored.npz")
    assert (status, error) == (0, "")
    assert len(loads) == 1, "neither data nor weights are loaded again"
    [(source, reference, transform, path, truth)] = drawn
    with np.load("scored.npz") as scored:
        np.testing.assert_array_equal(transform.rotation, scored["rotation"][0])
        np.testing.assert_array_equal(transform.translation, scored["translation"][0])
    assert np.allclose(transform.rotation, turns[0]) == (not refine)
    assert (path.suffix, source.shape, reference.shape) == (".png", (24, 3), (24, 3))
    assert Path("first.png").is_file()
    truths = true_transforms(score.pair_stream(config, root=None).batches())
    np.testing.assert_array_equal(truth.rotation, truths.rotation[0])
    moved = source @ truth.rotation.T + truth.translation
    distance = np.linalg.norm(moved[:, None] - reference[None], axis=2).min(axis=1)
    assert np.mean(distance < 1e-5) > 0.5, "most points of a pair are exact copies"


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ("--picture out.xyz", "--picture out.xyz: name a file that ends in .png or .pdf or .svg"),
        ("--save-transforms out", "--save-transforms out: name a file that ends in .npz"),
        ("--save-pairs out.npy", "--save-pairs out.npy: name a file that ends in .npz"),
        ("--json .", ". is a directory: name a file in it"),
        (
            "--json nowhere/out.json",
            "nowhere/out.json: the folder nowhere does not exist: make it first",
        ),
        ("--json c.toml", "c.toml is already read or written by this command"),
        (
            "--transforms x.npz --save-pairs x.npz",
            "x.npz is already read or written by this command",
        ),
        (
            "--save-pairs x.npz --save-transforms x.npz",
            "x.npz is already read or written by this command",
        ),
        (
            "--method cemnet:x.npz --save-pairs x.npz",
            "x.npz is already read or written by this command",
        ),
        ("--weights w/mine --json w/mine.json", "w/mine.json is already read or written"),
        ("--method weights:w/mine --save-pairs w/mine.npz", "w/mine.npz is already read"),
        ("--method icp --parts p --json p/evaluation.json", "p/evaluation.json is among the files"),
        (
            "--method icp --parts p --save-pairs p/batch_000001.npz",
            "p/batch_000001.npz is among the files that this command reads: choose another folder",
        ),
        (
            "--method icp --data.name folder --data.folder w --save-pairs w/new.npz",
            "w/new.npz is among the files",
        ),
        ("--checkpoint run --json run/best/r.json", "run/best/r.json is among the files"),
    ],
)
def test_an_output_that_cannot_be_written_is_refused_before_the_work(
    command, asked, options, message
):
    for folder in ("w", "p", "run/best"):
        Path(folder).mkdir(parents=True)
    for suffix in (".npz", ".json"):
        Path("w/mine").with_suffix(suffix).touch()
    status, printed, error = command(*options.split())
    assert (status, printed, asked) == (2, "", [])
    assert error.startswith(f"error: {message}")
    assert len(error.splitlines()) == 1


def test_the_figures_are_out_before_anything_that_may_fail(command, monkeypatch):
    def full(*_, **__):
        raise OSError(28, "No space left on device", "first.png")

    monkeypatch.setattr(pictures, "plot_pair", full)
    options = "--method identity --json out.json --save-pairs p.npz --picture first.png"
    status, printed, error = command(*options.split())
    told = "could not be written (No space left on device): choose another place."
    assert (status, error) == (2, f"error: first.png {told}\n")
    assert "MAE(R) deg" in printed
    assert json.loads(Path("out.json").read_text())["pairs"] == 3
    assert Path("p.npz").is_file()


@pytest.mark.parametrize(
    ("option", "place"),
    [("--json", "r.json"), ("--save-transforms", "r.npz"), ("--picture", "r.png")],
)
def test_an_output_is_whole_or_as_it_was(command, monkeypatch, option, place):
    def half(path):
        with path.open("w") as file:
            file.write("half")
        raise OSError(28, "No space left on device")

    Path(place).write_text("an older one")
    monkeypatch.setattr(Path, "write_text", lambda path, *_, **__: half(path))
    monkeypatch.setattr(np, "savez", lambda file, **_: half(Path(file.name)))
    monkeypatch.setattr(pictures, "plot_pair", lambda *a, **_: half(a[3]))
    status, printed, error = command("--method", "identity", option, place)
    assert (status, "MAE(R) deg" in printed) == (2, True)
    assert error.startswith(f"error: {place} could not be written (No space left on device)")
    assert Path(place).read_text() == "an older one"
    assert {path.name for path in Path().iterdir()} == {"c.toml", place}


def test_poses_that_are_none_are_written_all_the_same(command, monkeypatch):
    """Of minutes of work, to see which they are."""
    broken = RigidTransform(np.full((3, 3, 3), np.nan), np.zeros((3, 3)))
    monkeypatch.setattr(methods, "identity_method", lambda pair: broken)
    status, _, error = command("--method", "identity", "--save-transforms", "out.npz")
    assert status == 2
    assert error.startswith("error: the predicted transform of pair 0 is not finite")
    with np.load("out.npz") as written:
        assert np.isnan(written["rotation"]).all()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ("--pairs.outliers 200", "to test on such pairs give --test-pairs.outliers 200"),
        ("--pairs.outliers=0", "to test on such pairs give --test-pairs.outliers 0"),
        ("--pairs.independent-crops", "to test on such pairs give --test-pairs.independent-crops"),
        ("--loss.lambda_ 0.5", "it belongs to the training"),
        ("--train.steps 5", "it belongs to the training"),
        ("--data.train-shapes 5", "it belongs to the training"),
        ("--model.k 12", "the weights were trained with k = 5; leave it out"),
        ("--model.include-self", "the weights were trained with include_self = False"),
        ("--method icp --model.iterations 5", "icp is not a network; leave it out"),
        ("--method icp --weights modelnet40", "icp is evaluated; leave out one of the two"),
        ("--checkpoint run --model.k 12", "the weights were trained with k = 7"),
    ],
)
def test_an_option_without_effect_is_refused(command, asked, options, message):
    if "--checkpoint" in options:
        write_run("run")
    status, printed, error = command(*options.split())
    assert (status, printed, asked) == (2, "", [])
    idle = options[options.rindex("--") :].replace("=", " ")
    assert error.startswith(f"error: {idle} has no effect here: ")
    assert message in error
    assert len(error.splitlines()) == 1


@pytest.mark.parametrize(
    ("options", "section", "changed"),
    [
        ("", "model", {}),
        ("--test-pairs.outliers 200", "test_pairs", {"outliers": 200}),
        ("--model.iterations 5 --model.k 5", "model", {"iterations": 5}),
        ("--data.test-shapes 2 --pairs 1", "data", {"test_shapes": 2}),
        ("--checkpoint run", "model", {"iterations": 5}),
        ("--checkpoint run --model.k 7", "model", {"k": 7, "iterations": 5}),
        ("--checkpoint run --model.iterations 3", "model", {}),
        ("--checkpoint run --model.n-inliers 9", "model", {"n_inliers": 9, "iterations": 5}),
    ],
)
def test_released_weights_follow_the_file_and_a_run_its_training(
    command, asked, toml, options, section, changed
):
    """The command line has the last word on either, also where it says what the file says."""
    if "--checkpoint" in options:
        write_run("run")
    _, printed, error = command(*options.split())
    assert error == "error: not here\n"
    file = load_config(toml)
    expected = dataclasses.replace(getattr(file, section), **changed)
    assert asked == [dataclasses.replace(file, **{section: expected})]
    told = "--checkpoint" in options and "iterations" in changed
    assert ("model.iterations = 5 as run was trained, not 3 as in c.toml" in printed) == told
    assert told or printed == ""


def test_two_methods_are_refused(command, asked):
    status, _, error = command("--method", "icp", "--checkpoint", "run")
    assert (status, asked) == (2, [])
    assert error == "error: choose one of --checkpoint, --rienet, --method and --transforms.\n"


def test_given_is_what_the_command_line_says_whatever_it_says(toml):
    """Values of the file, of a flag, of several words, of zero and infinity; and nothing besides."""
    toml.write_text("[train]\nclip = inf\n[pairs]\njitter = 0.0\n")
    words = "--model.iterations 3 --model.no-include-self --model.channels 32 32 64 128"
    words += " --test-pairs.jitter 0 --train.clip inf --weights= --data.name modelnet40 --pairs 2"
    given = options.given_fields(evaluate.Options, [str(toml), *words.split()])
    expected = {"model.iterations", "model.include_self", "model.channels", "test_pairs.jitter"}
    assert given == expected | {"train.clip", "weights", "data.name"}
    assert options.given_fields(evaluate.Options, [str(toml)]) == frozenset()


def write_run(workdir):
    """A run of train.py as far as its configuration: another network, five iterations."""
    config = Config(model=ModelConfig(k=7, iterations=5, n_inliers=16))
    with open_run(workdir, config) as run:
        run.save(1, {"nothing": np.zeros(1)}, 0.5)


@pytest.mark.parametrize("option", ["--transforms", "--rienet"])
@pytest.mark.parametrize("content", [None, b"", b"PK\x03\x04cut"])
def test_a_file_that_cannot_be_read_is_one_line_and_status_2(command, option, content):
    path = Path("mine.npz")
    if content is None:
        path.mkdir()
    else:
        path.write_bytes(content)
    status, _, error = command(option, "mine.npz")
    assert status == 2
    assert error.startswith("error: mine.npz is ")
    assert len(error.splitlines()) == 1


def test_procedural_shapes_need_no_folder_of_data_sets(command, monkeypatch):
    monkeypatch.setenv("JAXREG_DATA", "/unmounted")
    assert command("--method", "identity")[0] == 0
    status, _, error = command("--method", "identity", "--data.name", "modelnet40")
    assert status == 2
    assert "$JAXREG_DATA is /unmounted, which is not a folder" in error


def test_a_mistake_on_the_command_line_is_one_line(tmp_path):
    toml = tmp_path / "c.toml"
    toml.write_text("[model]\nalpah = 1.0\n")
    done = script("evaluate.py", toml)
    assert done.returncode == 2
    assert "did you mean 'alpha'" in done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize("name", ["train.py", "evaluate.py"])
def test_data_that_is_not_there_is_one_line_and_status_2(tmp_path, name):
    toml = tmp_path / "c.toml"
    toml.write_text('[data]\nname = "modelnet40"\n')
    done = script(name, toml, "--data-root", tmp_path)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith("error: ")
    assert len(done.stderr.splitlines()) == 1


def test_processes_share_a_folder_and_the_last_one_prints_the_table(command, monkeypatch):
    whole = command("--method", "icp", "--batch", "1", "--json", "whole.json")
    assert whole[0] == 0
    share = ("--method", "icp", "--batch", "1", "--parts", "p", "--processes", "2")
    status, output, _ = command(*share, "--process-id", "1", "--json", "half.json")
    assert status == 0
    assert "the last to end, prints the table" in output
    assert not Path("half.json").exists()
    monkeypatch.setenv("JAX_NUM_PROCESSES", "2")
    monkeypatch.setenv("JAX_PROCESS_ID", "0")
    status, output, _ = command(
        "--method", "icp", "--batch", "1", "--parts", "p", "--json", "b.json"
    )
    assert status == 0
    one, both = (json.loads(Path(name).read_text()) for name in ("whole.json", "b.json"))
    assert one.pop("seconds_per_pair") > 0
    assert both.pop("seconds_per_pair") > 0
    assert one == both


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--processes", "2", "--process-id", "0"), "give --parts"),
        (("--parts", "p", "--processes", "2"), "--process-id K is missing"),
        (("--parts", "p", "--processes", "2", "--process-id", "2"), "from 0 to 1"),
    ],
)
def test_shares_that_do_not_fit_are_refused(command, options, message):
    status, _, error = command("--method", "identity", *options)
    assert status == 2
    assert message in error


@pytest.mark.parametrize("options", [(), ("--parts", "p")])
def test_in_the_shell_of_an_allocation_there_is_one_process(command, monkeypatch, options):
    """SLURM says there how many tasks a job may start, and which task this is only to a task."""
    monkeypatch.setenv("SLURM_NTASKS", "4")
    status, output, error = command("--method", "identity", *options)
    assert (status, error) == (0, "")
    assert "MAE(R) deg" in output


def test_without_parts_the_environment_does_not_share_an_evaluation(command, monkeypatch):
    monkeypatch.setenv("SLURM_NTASKS", "4")
    monkeypatch.setenv("SLURM_PROCID", "3")
    status, output, _ = command("--method", "identity")
    assert (status, "MAE(R) deg" in output) == (0, True)
    status, output, _ = command("--method", "identity", "--batch", "1", "--parts", "p")
    assert (status, "this process is done" in output) == (0, True)
