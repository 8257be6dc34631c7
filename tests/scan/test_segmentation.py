"""Labels from pictures: what is visible, votes of flawed parsers, ONNX parsers, the colour model, smoothing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import onnx
import pytest
import torch
import trimesh
from onnx import TensorProto, helper, numpy_helper
from scipy.ndimage import gaussian_filter
from small_session import small_session

from caphy.errors import CaphyError
from caphy.scan.colour_model import ColourModel
from caphy.scan.label_layouts import LAYOUTS, LabelLayout, find_layout
from caphy.scan.parsers import OnnxParser
from caphy.scan.scan import BODY, LOWER, UNKNOWN, UPPER, Scan
from caphy.scan.scan_set import ScanSet
from caphy.scan.segmentation import given_labels, segment, smoothed_labels, votes
from caphy.scan.views import scan_views


@pytest.fixture(scope="module")
def scans():
    """Three scans of the small session with their true labels."""
    session = small_session()
    given = ScanSet.read(session / "scans")
    return [
        given[i].with_labels(np.load(session / "truth" / "stills" / f"{given.names[i]}.npz")["labels"])
        for i in range(3)
    ]


def _accuracy(labels, scan):
    return float((labels == scan.labels).mean())


def test_thirty_two_views_see_from_all_round(scans):
    views = list(scan_views(scans[0], (48, 64)))
    assert len(views) == 32
    assert all(view.hit.mean() > 0.05 for view in views)
    heading = np.degrees([np.arctan2(*(view.camera.eye - view.camera.target)[[0, 2]]) for view in views])
    assert np.diff(np.sort(heading)).max() < 25


def test_what_stands_behind_is_not_visible():
    """Two plates face to face with a gap: a picture shows the front of the plate that it looks at, and no other."""
    plate = trimesh.creation.box((1.0, 1.0, 0.01)).subdivide().subdivide().subdivide()
    both = trimesh.util.concatenate([plate.copy().apply_translation((0, 0, z)) for z in (0.2, -0.2)])
    scan = Scan("plates", np.array(both.vertices), np.array(both.faces))
    for view in scan_views(scan, (96, 96)):
        eye = view.camera.eye
        if abs(eye[2]) < 2.0 * np.hypot(eye[0], eye[1]):
            continue  # only those that look at the plates rather straight
        shown = np.zeros(len(scan.vertices), bool)
        shown[view.visible()[0]] = True
        front = scan.vertices[:, 2] * np.sign(eye[2]) > 0.2
        far = scan.vertices[:, 2] * eye[2] < 0
        middle = np.abs(scan.vertices[:, :2]).max(axis=1) < 0.25
        assert shown[front & middle].all()
        assert not shown[far & middle].any()


class FlawedParser:
    """Knows the truth, blurs it, and says something else on a tenth of the person's pixels, in blots."""

    def __init__(self, truth):
        self.truth, self.random, self.right = truth, np.random.default_rng(3), []

    def parse(self, view):
        true = np.full(view.face.shape, UNKNOWN, np.uint8)
        true[view.hit] = self.truth[view.nearest_vertex]
        said = np.argmax([gaussian_filter((true == i).astype(float), 3) for i in range(3)], axis=0)
        blots = gaussian_filter(self.random.normal(size=true.shape), 5)
        wrong = blots > np.quantile(blots[view.hit], 0.9)
        said = np.where(wrong, (said + 1 + self.random.integers(2)) % 3, said)
        self.right.append((said == true)[view.hit].mean())
        return np.where(view.hit, said, UNKNOWN).astype(np.uint8)


def test_votes_of_a_flawed_parser(scans):
    parser = FlawedParser(scans[1].labels)
    labels = segment(scans[1], parser)
    assert np.mean(parser.right) < 0.9  # it is as bad as it says
    assert _accuracy(labels, scans[1]) >= 0.97


def test_the_colour_model_needs_no_labels(scans):
    bare = [replace(scan, labels=None) for scan in scans]
    model = ColourModel.fit(bare)
    assert min(_accuracy(smoothed_labels(scan, model.votes(scan)), scan) for scan in scans) > 0.9


def test_the_colour_model_says_what_it_misses(scans):
    with pytest.raises(CaphyError, match="has no colours"):
        ColourModel.fit([replace(scans[0], colours=None)])
    grey = np.full_like(scans[0].colours, 128)
    with pytest.raises(CaphyError, match="all vertices have one colour"):
        ColourModel.fit([replace(scans[0], colours=grey)])


def _trained(scan, classes, size):
    """A network of three convolutions over colour and place, trained on views of one scan: weights for each layer."""
    torch.manual_seed(0)
    layers = [torch.nn.Conv2d(5, 16, 3, padding=1), torch.nn.Conv2d(16, 16, 3, padding=1), torch.nn.Conv2d(16, 4, 1)]
    net = torch.nn.Sequential(layers[0], torch.nn.ReLU(), layers[1], torch.nn.ReLU(), layers[2])
    images, truth = [], []
    for view in list(scan_views(scan, size))[::2]:
        images.append(view.colour.transpose(2, 0, 1).astype(np.float32) / 255 - 0.5)
        label = np.zeros(view.face.shape, np.int64)
        label[view.hit] = 1 + scan.labels[view.nearest_vertex]
        truth.append(label)
    x, y = torch.from_numpy(np.stack(images)), torch.from_numpy(np.stack(truth))
    x = torch.cat([x, torch.from_numpy(_places(size)).expand(len(x), -1, -1, -1)], 1)
    optimiser = torch.optim.Adam(net.parameters(), 0.02)
    for _ in range(80):
        optimiser.zero_grad()
        torch.nn.functional.cross_entropy(net(x), y).backward()
        optimiser.step()
    return [(layer.weight.detach().numpy(), layer.bias.detach().numpy()) for layer in layers]


def _places(size):
    x, y = np.meshgrid(np.linspace(-1, 1, size[0]), np.linspace(-1, 1, size[1]))
    return np.stack([x, y])[None].astype(np.float32)


def _write_graph(path, layers, size):
    """The network as an ONNX graph that takes an image as published parsers do."""
    tensors = [numpy_helper.from_array(_places(size), "place")]
    nodes = [helper.make_node("Concat", ["image", "place"], ["x0"], axis=1)]
    for i, (weight, bias) in enumerate(layers):
        tensors += [numpy_helper.from_array(weight, f"w{i}"), numpy_helper.from_array(bias, f"b{i}")]
        pad = weight.shape[2] // 2
        last = i == len(layers) - 1
        nodes.append(
            helper.make_node("Conv", [f"x{i}", f"w{i}", f"b{i}"], ["scores" if last else f"y{i}"], pads=[pad] * 4)
        )
        if not last:
            nodes.append(helper.make_node("Relu", [f"y{i}"], [f"x{i + 1}"]))
    image = helper.make_tensor_value_info("image", TensorProto.FLOAT, [1, 3, size[1], size[0]])
    scores = helper.make_tensor_value_info("scores", TensorProto.FLOAT, [1, 4, size[1], size[0]])
    model = helper.make_model(
        helper.make_graph(nodes, "parser", [image], [scores], tensors), opset_imports=[helper.make_opsetid("", 17)]
    )
    model.ir_version = 8
    onnx.save(model, path)


OWN = LabelLayout(
    classes=("backdrop", "person", "shirt", "trousers"),
    upper=("shirt",),
    lower=("trousers",),
    backdrop=("backdrop",),
    size=(96, 64),
    mean=(0.5, 0.5, 0.5),
    std=(1.0, 1.0, 1.0),
)


@pytest.fixture(scope="module")
def graph(scans, tmp_path_factory):
    path = tmp_path_factory.mktemp("parser") / "parser.onnx"
    _write_graph(path, _trained(scans[0], 4, (64, 96)), (64, 96))
    return path


def test_an_onnx_parser_trained_on_one_scan_labels_others(scans, graph):
    labels = segment(scans[2], OnnxParser(graph, OWN), (128, 192))
    assert _accuracy(labels, scans[2]) > 0.9


def test_an_onnx_parser_puts_a_wide_picture_where_it_was(scans, graph):
    """Letterboxing and its inverse: what hits is labelled, in pictures of any shape."""
    parser = OnnxParser(graph, OWN)
    for size in ((64, 96), (120, 90), (90, 160)):
        view = next(iter(scan_views(scans[0], size)))
        said = parser.parse(view)
        true = scans[0].labels[view.nearest_vertex]
        assert (said[view.hit] == true).mean() > 0.8
        assert (said[~view.hit] == UNKNOWN).all()


def test_an_onnx_parser_with_another_layout_is_refused(scans, graph):
    parser = OnnxParser(graph, LAYOUTS["schp-lip"])
    with pytest.raises(CaphyError, match="for the 20 classes of this layout"):
        parser.parse(next(iter(scan_views(scans[0], (32, 48)))))


def test_a_file_that_is_no_graph(tmp_path):
    (tmp_path / "a.onnx").write_bytes(b"nonsense")
    with pytest.raises(CaphyError, match="cannot load this graph"):
        OnnxParser(tmp_path / "a.onnx", OWN)


@pytest.mark.parametrize(
    ("name", "count"), [("schp-lip", 20), ("schp-atr", 18), ("segformer-clothes", 18), ("sapiens", 28)]
)
def test_published_layouts(name, count):
    layout = find_layout(name)
    assert len(layout.classes) == len(set(layout.classes)) == count
    label = dict(zip(layout.classes, layout.label_of_class, strict=True))
    assert label["background"] == -1
    assert label.get("hair") == BODY
    assert {label[c] for c in layout.classes if c in ("pants", "skirt", "lower-clothing")} == {LOWER}
    assert {label[c] for c in layout.classes if c in ("upper-clothes", "coat", "upper-clothing")} == {UPPER}
    assert layout.source


def test_a_layout_from_a_file(tmp_path):
    path = tmp_path / "own.json"
    path.write_text(
        '{"classes": ["none", "skin", "top", "skirt"], "upper": ["top"], "lower": ["skirt"], "backdrop": ["none"], '
        '"size": [64, 48]}'
    )
    assert find_layout(str(path)).label_of_class == [-1, BODY, UPPER, LOWER]
    path.write_text('{"classes": ["none"], "upper": ["top"], "lower": [], "backdrop": [], "size": [1, 1]}')
    with pytest.raises(CaphyError, match="'top' must be one of"):
        find_layout(str(path))
    with pytest.raises(CaphyError, match="neither a known label layout"):
        find_layout("nobody's")


def test_gaps_are_filled_and_islands_go(scans):
    scan = scans[0]
    random = np.random.default_rng(0)
    holed = scan.labels.copy()
    holed[random.random(len(holed)) < 0.3] = UNKNOWN
    chest = np.flatnonzero(scan.labels == UPPER)[500]
    island = np.argsort(np.linalg.norm(scan.vertices - scan.vertices[chest], axis=1))[:20]
    island = island[scan.labels[island] == UPPER]
    holed[island] = LOWER
    labels = given_labels(scan.with_labels(holed))
    assert _accuracy(labels, scan) > 0.99
    assert (labels[island] == UPPER).all()


def test_a_scan_with_no_votes_stays_unknown(scans):
    count = np.zeros((len(scans[0].vertices), 3))
    assert (smoothed_labels(scans[0], count) == UNKNOWN).all()
    empty = scans[0].with_labels(np.full(len(count), UNKNOWN))
    with pytest.raises(CaphyError, match="labels are empty"):
        given_labels(empty)


def test_votes_count_views(scans):
    class Shirt:
        def parse(self, view):
            return np.full(view.face.shape, UPPER, np.uint8)

    count = votes(scans[0], Shirt(), scan_views(scans[0], (64, 96)))
    assert count[:, [BODY, LOWER]].sum() == 0
    assert 0 < count.max() <= 32
