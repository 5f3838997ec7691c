"""Trackers of a pysot checkout; a real one where LAE_SIM_PYSOT says where it is."""

from __future__ import annotations

import importlib
import os
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from lae_sim.errors import LaeError
from lae_sim.trackers.names import make_tracker

torch = pytest.importorskip("torch", reason="pysot is a toolkit for PyTorch")

from lae_sim.trackers.pysot import PySot  # noqa: E402

# A toolkit of the layout of pysot, small: its tracker says what it crops and how bright that is.
FAKE = {
    "__init__.py": "",
    "core/__init__.py": "",
    "core/config.py": """
import pathlib
class Config:
    CUDA = True
    GAIN = 1
    def merge_from_file(self, name):
        for line in pathlib.Path(name).read_text().splitlines():
            key, _, value = line.partition(":")
            if not hasattr(self, key):
                raise KeyError("Non-existent config key: " + key)
            setattr(self, key, int(value))
cfg = Config()
""",
    "models/__init__.py": "",
    "models/model_builder.py": """
import visdom
import torch
from pysot.core.config import cfg
class Helper: pass
class ModelBuilder(torch.nn.Module):
    def __init__(self):
        super().__init__()
        self.norm = torch.nn.BatchNorm2d(cfg.GAIN).cuda()
    def template(self, crop):
        assert not self.training
        self.mean = crop.mean().cuda()
""",
    "tracker/__init__.py": "",
    "tracker/base_tracker.py": "class SiameseTracker: pass\n",
    "tracker/siamrpn_tracker.py": """
import numpy as np
import torch
from pysot.tracker.base_tracker import SiameseTracker
class SiamRPNTracker(SiameseTracker):
    def __init__(self, model):
        self.model = model
    def crop(self, image):
        (x, y), (w, h) = self.center_pos, self.size
        crop = image[int(y - h / 2) : int(y + h / 2), int(x - w / 2) : int(x + w / 2)]
        return torch.from_numpy(crop.astype(np.float)).cuda()
    def init(self, image, box):
        self.center_pos = np.array([box[0] + box[2] / 2, box[1] + box[3] / 2])
        self.size = np.array([box[2], box[3]])
        self.model.template(self.crop(image))
    def track(self, image):
        bright = self.crop(image).mean() - self.model.mean
        self.size *= 1.5
        box = [*(self.center_pos - self.size / 2), *self.size]
        return {"bbox": box, "best_score": bright.numpy()}
""",
    "tracker/tracker_builder.py": """
from pysot.tracker.siamrpn_tracker import SiamRPNTracker
def build_tracker(model):
    return SiamRPNTracker(model)
""",
}
WEIGHTS = {"norm.weight": 2, "norm.bias": 0, "norm.running_mean": 0, "norm.running_var": 1}


@pytest.fixture(autouse=True)
def _own_imports(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Each test imports its own checkout."""
    monkeypatch.setattr(sys, "path", list(sys.path))
    before = set(sys.modules)
    yield
    for name in set(sys.modules) - before:
        kind = type(sys.modules[name]).__name__
        if name.partition(".")[0] == "pysot" or kind == "_StandIn":
            del sys.modules[name]


def save(path: Path, sizes: dict[str, int], prefix: str = "", **more: Any) -> None:
    weights = {prefix + name: torch.full((1,), float(v)) for name, v in sizes.items()}
    torch.save({"state_dict": weights, **more} if more else weights, path)


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    for name, text in FAKE.items():
        (tmp_path / "pysot" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "pysot" / name).write_text(text)
    (tmp_path / "experiments" / "small_model").mkdir(parents=True)
    (tmp_path / "experiments" / "small_model" / "config.yaml").write_text("GAIN: 1\n")
    save(tmp_path / "model.pth", WEIGHTS)
    return tmp_path


def options(folder: Path, **more: Any) -> dict[str, Any]:
    config = folder / "experiments" / "small_model" / "config.yaml"
    made = {"config": str(config), "snapshot": str(folder / "model.pth")}
    return {"checkout": str(folder), **made, **more}


FRAME = np.zeros((60, 80, 3), np.uint8)
FRAME[:, 40:] = 200


def test_tracking_and_search_control(checkout: Path) -> None:
    tracker = make_tracker("pysot", options(checkout))
    tracker.init(FRAME, [10, 20, 9, 11])
    assert tracker.track(FRAME) == ([7.75, 17.25, 13.5, 16.5], 0.0)
    tracker.set_search(60, 30, 5, 7)  # type: ignore[attr-defined]  # ints would be cut off
    assert tracker.track(FRAME) == ([56.25, 24.75, 7.5, 10.5], 200.0)


def test_weights_are_loaded(checkout: Path) -> None:
    # as a training snapshot has it: of DataParallel, and with NumPy's numbers beside the weights
    more = {"epoch": np.int64(3), "lr": np.float64(0.1)}
    save(checkout / "model.pth", WEIGHTS, "module.", **more)
    network = PySot(**options(checkout))._tracker.model
    assert network.norm.weight.item() == 2
    assert not network.training


def test_devices(checkout: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[Any] = []
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    monkeypatch.setattr(torch.cuda, "set_device", calls.append)
    monkeypatch.setattr(torch.cuda, "synchronize", lambda: calls.append("sync"))
    for kind in (torch.Tensor, torch.nn.Module):
        monkeypatch.setattr(kind, "cuda", lambda value: value)
    monkeypatch.setattr(torch.nn.Module, "to", lambda module, device: calls.append(device))
    tracker = PySot(**options(checkout, device="cuda:1"))
    tracker.sync()
    assert calls == [1, "cuda:1", "sync"]
    assert sys.modules["pysot.core.config"].cfg.CUDA is True
    monkeypatch.undo()
    PySot(**options(checkout)).sync()
    assert calls == [1, "cuda:1", "sync"]
    assert sys.modules["pysot.core.config"].cfg.CUDA is False


def test_no_code_of_a_snapshot_is_run(checkout: Path) -> None:
    class Bomb:
        def __reduce__(self) -> Any:
            return (Path(checkout / "ran").touch, ())

    torch.save({"state_dict": {"x": Bomb()}}, checkout / "model.pth")
    with pytest.raises(LaeError, match=r"model\.pth: not a snapshot"):
        PySot(**options(checkout))
    assert not (checkout / "ran").exists()


@pytest.mark.parametrize(
    ("weights", "told"),
    [
        ({}, r"lacks 4 \(such as norm\.weight\)"),
        ({**WEIGHTS, "head.bias": 1}, r"also has 1 \(such as head\.bias\)"),
    ],
)
def test_weights_of_another_model(checkout: Path, weights: dict[str, int], told: str) -> None:
    save(checkout / "model.pth", weights)
    with pytest.raises(LaeError, match=rf"model\.pth: not weights of the model .*{told}"):
        PySot(**options(checkout))


def test_weights_of_another_size(checkout: Path) -> None:
    config = checkout / "experiments" / "small_model" / "config.yaml"
    config.write_text("GAIN: 3\n")
    with pytest.raises(LaeError, match=r"has in another shape 4 \(such as norm\.weight\)"):
        PySot(**options(checkout))


def test_describe(checkout: Path) -> None:
    (checkout / ".git" / "refs" / "heads").mkdir(parents=True)
    (checkout / ".git" / "HEAD").write_text("ref: refs/heads/master\n")
    (checkout / ".git" / "refs" / "heads" / "master").write_text("ab" * 20 + "\n")
    found = PySot(**options(checkout)).describe()
    assert found["name"] == "small_model"
    assert found["version"] == "ab" * 20
    assert found["settings"]["tracker"] == "SiamRPNTracker"
    assert found["settings"]["device"] == "cpu"
    assert len(found["weights_digest"]) == 64
    assert "search" not in found  # this configuration does not say


def test_the_search_region_is_the_configurations(checkout: Path) -> None:
    tracker = PySot(**options(checkout))
    config: Any = importlib.import_module("pysot.core.config").cfg
    track = {"EXEMPLAR_SIZE": 127, "INSTANCE_SIZE": 287, "WINDOW_INFLUENCE": 0.0}
    config.TRACK = SimpleNamespace(**track)
    assert tracker.describe()["search"] == {
        "half_side": 287 / 127 / 2,
        "window": False,
        "source": "crops of 127 and 287 pixels (config.yaml)",
    }
    config.TRACK = SimpleNamespace(**track, CONTEXT_AMOUNT=0.3)
    assert "search" not in tracker.describe()


def test_a_fork_with_several_trackers(checkout: Path) -> None:
    folder = checkout / "pysot" / "tracker"
    (folder / "tracker_builder.py").unlink()
    assert PySot(**options(checkout)).describe()["settings"]["tracker"] == "SiamRPNTracker"
    text = (folder / "siamrpn_tracker.py").read_text()
    (folder / "other_tracker.py").write_text(text.replace("SiamRPN", "Other"))
    with pytest.raises(LaeError, match="option tracker to one of OtherTracker, SiamRPNTracker"):
        PySot(**options(checkout))
    found = PySot(**options(checkout, tracker="OtherTracker")).describe()
    assert found["settings"]["tracker"] == "OtherTracker"


@pytest.mark.parametrize(
    ("more", "told"),
    [
        ({"checkout": "/nowhere"}, "/nowhere: no such folder"),
        ({"checkout": "experiments"}, "looked in it for pysot/core/config.py, found 0"),
        ({"config": "none.yaml"}, r"none\.yaml: no such file"),
        ({"snapshot": "none.pth"}, r"none\.pth: no such file"),
        ({"device": "tpu"}, "it is cpu, cuda or cuda:N"),
        ({"device": "cuda:99"}, "no such device"),
        ({"snapshot": "pysot/core/config.py"}, "not a snapshot"),
    ],
)
def test_what_a_user_gets_wrong(
    checkout: Path, monkeypatch: pytest.MonkeyPatch, more: dict[str, Any], told: str
) -> None:
    monkeypatch.chdir(checkout)
    with pytest.raises(LaeError, match=told):
        PySot(**options(checkout, **more))


def test_an_unknown_key_of_the_configuration(checkout: Path) -> None:
    config = checkout / "experiments" / "small_model" / "config.yaml"
    config.write_text("NEW.KEY: 1\n")
    with pytest.raises(LaeError, match=r"config\.yaml: .*Non-existent config key: NEW\.KEY"):
        PySot(**options(checkout))


def test_a_package_that_the_checkout_needs(checkout: Path) -> None:
    (checkout / "pysot" / "core" / "config.py").write_text("import yacs_of_nowhere\n")
    with pytest.raises(LaeError, match="it needs yacs_of_nowhere: pip install yacs_of_nowhere"):
        PySot(**options(checkout))


def test_two_checkouts_of_one_name(checkout: Path) -> None:
    PySot(**options(checkout))
    (checkout / "other" / "pysot" / "core").mkdir(parents=True)
    (checkout / "other" / "pysot" / "core" / "config.py").touch()
    with pytest.raises(LaeError, match="this process has imported another 'pysot'"):
        PySot(**options(checkout, checkout=str(checkout / "other")))


# ---- the toolkit itself


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(
    "model",
    [
        "siamrpn_alex_dwxcorr",
        "siamrpn_mobilev2_l234_dwxcorr",
        "siamrpn_r50_l234_dwxcorr",
        "siammask_r50_l3",
    ],
)
def test_the_toolkits_own_boxes(model: str, tmp_path: Path) -> None:
    root = os.environ.get("LAE_SIM_PYSOT")
    if not root:
        pytest.skip("LAE_SIM_PYSOT is not set to a checkout of pysot")
    pytest.importorskip("yacs", reason="pysot needs it")
    config = str(Path(root) / "experiments" / model / "config.yaml")
    snapshot = tmp_path / "model.pth"
    snapshot.touch()
    made = {"checkout": root, "config": config, "snapshot": str(snapshot)}
    with pytest.raises(LaeError, match="not a snapshot"):  # after which the toolkit is imported
        PySot(**made)

    rng = np.random.default_rng(0)
    frames = np.repeat(rng.integers(0, 256, (1, 240, 320, 3), np.uint8), 4, 0)
    texture = rng.integers(0, 128, (36, 40, 3), np.uint8)
    for i, frame in enumerate(frames):
        frame[80 + 2 * i : 116 + 2 * i, 120 + 3 * i : 160 + 3 * i] = texture
    box = [120.0, 80.0, 40.0, 36.0]

    torch.manual_seed(7)
    build = importlib.import_module("pysot.models.model_builder").ModelBuilder
    network = build().eval()
    state = network.state_dict()
    with torch.no_grad():  # random weights of a head would throw the box out of the frame
        network.template(torch.rand(1, 3, 127, 127) * 255)
        size = importlib.import_module("pysot.core.config").cfg.TRACK.INSTANCE_SIZE
        spread = network.track(torch.rand(1, 3, size, size) * 255)["loc"].std()
        for name in [n for n in state if ".loc.head.3." in n]:
            state[name] *= 0.3 / spread
    torch.save({f"module.{name}": value for name, value in state.items()}, snapshot)

    live = PySot(**made)
    live.init(frames[0], box)
    found = [live.track(frame) for frame in frames[1:]]

    own = importlib.import_module("pysot.tracker.tracker_builder").build_tracker(network)
    own.init(frames[0], box)
    outputs = [own.track(frame) for frame in frames[1:]]
    assert found == [(o["bbox"], o["best_score"]) for o in outputs]
    assert np.ptp([box for box, _ in found], axis=0).min() > 0  # it did move

    cropped = []
    crop = live._tracker.get_subwindow
    live._tracker.get_subwindow = lambda im, pos, *a: (
        cropped.append([*pos, a[1]]),
        crop(im, pos, *a),
    )[1]
    live.set_search(100.5, 60.25, 30, 30)
    live.track(frames[0])
    live.set_search(100.5, 60.25, 60, 60)
    live.track(frames[0])
    assert [c[:2] for c in cropped] == [[100.5, 60.25]] * 2
    assert cropped[1][2] == pytest.approx(2 * cropped[0][2], abs=1)
