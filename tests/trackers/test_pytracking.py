"""Trackers of a pytracking checkout; a real one where LAE_SIM_PYTRACKING says where it is."""

from __future__ import annotations

import importlib
import os
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lae_sim.errors import LaeError
from lae_sim.trackers.names import make_tracker

torch = pytest.importorskip("torch", reason="pytracking is a toolkit for PyTorch")
pytest.importorskip("cv2", reason="pytracking needs OpenCV")

from lae_sim.trackers.checkout import stand_ins  # noqa: E402
from lae_sim.trackers.pytracking import _UNUSED, PyTracking, precise_roi_pooling  # noqa: E402

# A toolkit of the layout of pytracking, small: its tracker pools an image around its position.
FAKE = {
    "ltr/__init__.py": "",
    "ltr/admin/__init__.py": "",
    "ltr/net.py": """
import torch
from torchvision.models.resnet import BasicBlock, model_urls
from ltr.external.PreciseRoIPooling.pytorch.prroi_pool import PrRoIPool2D
class Constructor:
    fun_name = "smallnet"
class SmallNet(torch.nn.Module):
    constructor = Constructor()
    def __init__(self):
        super().__init__()
        self.pool = PrRoIPool2D(1, 1, 1.0)
        self.gain = torch.nn.Parameter(torch.ones(()))
""",
    "ltr/models/__init__.py": "",
    "ltr/models/backbone/__init__.py": "",
    "ltr/models/backbone/resnet.py": "class BasicBlock: pass\nclass Bottleneck: pass\n",
    "pytracking/__init__.py": "import matplotlib.pyplot, visdom, jpeg4py\n",
    "pytracking/libs/__init__.py": "",
    "pytracking/libs/tensorlist.py": """
class TensorList(list):
    def __getattr__(self, name):
        return lambda *a: TensorList(getattr(e, name)(*a) for e in self)
""",
    "pytracking/parameter/small/plain.py": """
class Net:
    net_path = "plain.pth"
    def initialize(self):
        import torch
        from ltr.net import SmallNet
        import ltr.admin.local
        self.net = SmallNet()
        self.net.load_state_dict(torch.load(self.net_path)["net"])
class Params:
    def has(self, name):
        return hasattr(self, name)
def parameters():
    params = Params()
    params.use_gpu, params.net = True, Net()
    return params
""",
    "pytracking/tracker/small/__init__.py": """
import torch
from pytracking.libs.tensorlist import TensorList
class Small:
    def __init__(self, params):
        self.params = params
    def initialize_features(self):
        if not getattr(self, "features_initialized", False):
            self.params.net.initialize()
    def initialize(self, image, info):
        assert not self.params.use_gpu and not self.params.net.use_gpu
        self.initialize_features()
        x, y, w, h = info["init_bbox"]
        self.pos = torch.tensor([y + (h - 1) / 2, x + (w - 1) / 2])
        self.target_sz = torch.tensor([h, w])
        self.target_scale = self.target_sz.prod().sqrt() / 10
        self.base_target_sz = self.target_sz / self.target_scale
    def track(self, image):
        (y, x), (h, w) = self.pos.tolist(), (self.base_target_sz * self.target_scale).tolist()
        roi = torch.tensor([[0, x - w / 2, y - h / 2, x + w / 2, y + h / 2]], requires_grad=True)
        planes = torch.from_numpy(image).float().permute(2, 0, 1)[None]
        mean = self.params.net.net.pool(planes, roi)
        mean.sum().backward()
        assert torch.isfinite(roi.grad).all()
        row = torch.rand(1, 7)
        assert torch.allclose(torch.irfft(torch.rfft(row, 1), 1, signal_sizes=[7]), row)
        self.debug_info = {"max_score": mean[0, 0].item() + row[0, 0].item()}
        lost = mean[0, 0].item() == 0
        box = [x - (w - 1) / 2, y - (h - 1) / 2, w, h]
        return {"target_bbox": [-1, -1, -1, -1] if lost else box}
def get_tracker_class():
    assert torch.nn.functional.relu(TensorList([torch.ones(2)])[0]).sum() == 2
    return Small
""",
}


@pytest.fixture(autouse=True)
def _own_imports(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Each test imports its own checkout."""
    monkeypatch.setattr(sys, "path", list(sys.path))
    before = set(sys.modules)
    yield
    for name in set(sys.modules) - before:
        kind = type(sys.modules[name]).__name__
        if name.partition(".")[0] in ("ltr", "pytracking") or kind == "_StandIn":
            del sys.modules[name]


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    for name, text in FAKE.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    # of a class, as the toolkit's networks are, so that it can only be read by trusting it
    torch.save({"net": {"gain": torch.ones(())}, "of": Path("x")}, tmp_path / "net.pth")
    return tmp_path


def options(folder: Path, **more: Any) -> dict[str, Any]:
    made = {"tracker": "small", "parameter": "plain", "network": str(folder / "net.pth")}
    return {"checkout": str(folder), "trust_checkpoint": True, **made, **more}


FRAME = np.zeros((60, 80, 3), np.uint8)
FRAME[:, 40:] = (10, 20, 200)  # red at the right


def test_the_toolkit_gets_what_it_needs(checkout: Path) -> None:
    tracker = make_tracker("pytracking", options(checkout))
    tracker.init(FRAME, [50, 20, 11, 7])
    box, score = tracker.track(FRAME)  # type: ignore[misc]
    assert box == pytest.approx([50, 20, 11, 7])
    assert 200 <= score < 201  # RGB: the first plane is red
    torch.rand(3)
    tracker.init(FRAME, [50, 20, 11, 7])
    assert tracker.track(FRAME) == (box, score)  # seeded at each sequence
    other = make_tracker("pytracking", options(checkout, seed=1))
    other.init(FRAME, [50, 20, 11, 7])
    assert other.track(FRAME)[1] != score  # type: ignore[index]
    assert not list(checkout.glob("**/local.py"))  # nothing written into the checkout


def test_search_control(checkout: Path) -> None:
    tracker = PyTracking(**options(checkout))
    tracker.init(FRAME, [50, 20, 11, 7])
    tracker.set_search(62.5, 30.5, 22, 14)
    box, _ = tracker.track(FRAME)  # type: ignore[misc]
    assert box == pytest.approx([62.5 - 11, 30.5 - 7, 22, 14])  # this centre and size
    tracker.set_search(20, 30, 11, 7)
    assert tracker.track(FRAME) is None  # black there


def test_describe(checkout: Path) -> None:
    found = PyTracking(**options(checkout)).describe()
    assert found["name"] == "small-plain"
    assert found["settings"]["network"] == "smallnet"
    assert found["settings"]["device"] == "cpu"
    assert len(found["weights_digest"]) == 64
    assert "search" not in found


def test_the_search_region_is_the_parameters(checkout: Path) -> None:
    file = checkout / "pytracking" / "parameter" / "small" / "plain.py"
    text = file.read_text()
    file.write_text(text.replace("return params", "params.search_area_scale = 5; return params"))
    search = PyTracking(**options(checkout)).describe()["search"]
    assert (search["half_side"], search["window"]) == (1.25, False)


def test_checkpoints_are_read_only_where_trusted(checkout: Path) -> None:
    with pytest.raises(LaeError, match=r"net\.pth.*--trust-checkpoint"):
        PyTracking(**options(checkout, trust_checkpoint=False))


@pytest.mark.parametrize(
    ("more", "told"),
    [
        ({"checkout": "/nowhere"}, "/nowhere: no such folder"),
        ({"checkout": "/"}, "looked in it for pytracking/tracker/small"),
        ({"network": "none.pth"}, r"none\.pth: no such file"),
        ({"parameter": "large"}, r"looked in it for pytracking/parameter/small/large\.py"),
        ({"device": "tpu"}, "it is cpu, cuda or cuda:N"),
        ({"device": "cuda:99"}, "no such device"),
        ({"pooling": "exact"}, "torch or extension"),
        ({"network": "ltr/net.py"}, "not a network of small/plain"),
    ],
)
def test_what_a_user_gets_wrong(
    checkout: Path, monkeypatch: pytest.MonkeyPatch, more: dict[str, Any], told: str
) -> None:
    monkeypatch.chdir(checkout)
    with pytest.raises(LaeError, match=told):
        PyTracking(**options(checkout, **more))


def test_a_network_of_another_kind(checkout: Path) -> None:
    for kind in ("tracker", "parameter"):
        (checkout / "pytracking" / kind / "small").rename(checkout / "pytracking" / kind / "atom")
    with pytest.raises(LaeError, match=r"net\.pth: atom takes a ATOMnet, this is a SmallNet"):
        PyTracking(**options(checkout, tracker="atom"))


def test_pooling_is_the_integral_of_the_interpolation() -> None:
    torch.manual_seed(0)
    features = torch.rand(2, 3, 6, 7, dtype=torch.float64)
    rois = torch.tensor(
        [[0, 1.3, 0.2, 5.1, 3.9], [1, -2.5, 1.0, 3.0, 8.5], [1, 2.2, 2.1, 2.6, 2.3]],
        dtype=torch.float64,
    )
    scale, size = 0.8, (2, 3)
    found = precise_roi_pooling(features, rois, size, scale)
    assert found.shape == (3, 3, 2, 3)
    n = 400
    for i, (image, *corners) in enumerate(rois.tolist()):
        x1, y1, x2, y2 = (value * scale for value in corners)
        x = x1 + (x2 - x1) * (np.arange(size[1] * n) + 0.5) / (size[1] * n)
        y = y1 + (y2 - y1) * (np.arange(size[0] * n) + 0.5) / (size[0] * n)
        in_x = np.maximum(0, 1 - abs(x[:, None] - np.arange(7)))  # zero outside the samples
        in_y = np.maximum(0, 1 - abs(y[:, None] - np.arange(6)))
        values = in_y @ features[int(image)].numpy() @ in_x.T
        means = values.reshape(3, size[0], n, size[1], n).mean((2, 4))
        np.testing.assert_allclose(found[i].numpy(), means, atol=2e-5)
    one = precise_roi_pooling(features[1:], rois[1:], size, scale)  # where there is one image
    np.testing.assert_allclose(one.numpy(), found[1:].numpy())


def test_pooling_has_the_gradients_of_the_integral() -> None:
    torch.manual_seed(0)
    features = torch.rand(1, 2, 5, 5, dtype=torch.float64, requires_grad=True)
    corners = torch.tensor([[0.31, 0.72, 3.4, 2.9]], dtype=torch.float64, requires_grad=True)

    def pooled(f: Any, c: Any) -> Any:
        return precise_roi_pooling(f, torch.cat([c.new_zeros(1, 1), c], 1), (2, 2), 1.0)

    assert torch.autograd.gradcheck(pooled, (features, corners))
    flat = torch.tensor([[0, 2.0, 1.0, 2.0, 3.0], [0, 3.0, 1.0, 2.0, 3.0]], dtype=torch.float64)
    assert (precise_roi_pooling(features, flat, (2, 2), 1.0) == 0).all()


# ---- the toolkit itself


def network_of(name: str) -> Any:
    """The toolkit's network of that parameter file, with its usual settings and random weights."""
    random = {"backbone_pretrained": False}
    if name == "default":
        return importlib.import_module("ltr.models.bbreg.atom").atom_resnet18(**random)
    dimp = importlib.import_module("ltr.models.tracking.dimpnet")
    shared = {"filter_size": 4, "optim_iter": 5, "clf_feat_norm": True, **random}
    if name == "prdimp18":
        return dimp.klcedimpnet18(normalize_label=True, init_initializer="zero", **shared)
    make = {"dimp18": dimp.dimpnet18, "dimp50": dimp.dimpnet50}[name]
    return make(num_dist_bins=100, bin_displacement=0.1, mask_init_factor=3.0, **shared)


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(
    ("tracker", "parameter"),
    [("atom", "default"), ("dimp", "dimp18"), ("dimp", "dimp50"), ("dimp", "prdimp18")],
)
def test_the_toolkits_own_boxes(
    tracker: str, parameter: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    root = os.environ.get("LAE_SIM_PYTRACKING")
    if not root:
        pytest.skip("LAE_SIM_PYTRACKING is not set to a checkout of pytracking")
    options = {"checkout": root, "tracker": tracker, "parameter": parameter}
    empty = tmp_path / "empty.pth"
    empty.touch()
    with pytest.raises(LaeError, match="not a network"):  # after which the toolkit is imported
        PyTracking(network=str(empty), trust_checkpoint=True, **options)
    torch.manual_seed(7)
    with stand_ins(_UNUSED):
        network = network_of(parameter)
    state = {"net": network.state_dict(), "constructor": network.constructor}
    torch.save(state, tmp_path / "net.pth")

    texture = np.random.default_rng(0).integers(0, 256, (36, 40, 3), np.uint8)
    frames = np.full((4, 240, 320, 3), 90, np.uint8)
    for i, frame in enumerate(frames):
        frame[80 + 2 * i : 116 + 2 * i, 120 + 3 * i : 160 + 3 * i] = texture
    box = [120.0, 80.0, 40.0, 36.0]

    live = PyTracking(network=str(tmp_path / "net.pth"), trust_checkpoint=True, **options)
    live._params.target_not_found_threshold = -9.0  # random weights find little
    runs = []
    for _ in range(2):  # a second sequence is as the first
        live.init(frames[0], box)
        runs.append([live.track(frame) for frame in frames[1:]])

    module = importlib.import_module(f"pytracking.parameter.{tracker}.{parameter}")
    params = module.parameters()
    params.use_gpu, params.target_not_found_threshold = False, -9.0
    for holder in [params.net] if params.has("net") else params.features.features:
        holder.use_gpu, holder.net_path = False, str(tmp_path / "net.pth")
    load = torch.load
    monkeypatch.setattr(torch, "load", lambda *a, **k: load(*a, **{**k, "weights_only": False}))
    own = live._class(params)
    own.initialize_features()
    torch.manual_seed(0)
    own.initialize(frames[0][..., ::-1].copy(), {"init_bbox": box})
    expected = []
    for frame in frames[1:]:
        found = own.track(frame[..., ::-1].copy())["target_bbox"]
        expected.append((found, own.debug_info["max_score"]))
    assert runs == [expected, expected]
    assert expected[-1][0] != box  # it did move

    sampled = []
    user = "extractor" if tracker == "atom" else "preprocessing"
    sampler = sys.modules[f"pytracking.features.{user}"]
    sample = sampler.sample_patch
    monkeypatch.setattr(
        sampler,
        "sample_patch",
        lambda im, pos, *a, **k: (sampled.append(pos), sample(im, pos, *a, **k))[1],
    )
    live.set_search(100.5, 60.5, 30, 30)
    live.track(frames[0])
    np.testing.assert_allclose(sampled[0].numpy(), [60, 100], atol=12)  # it is put on the grid
