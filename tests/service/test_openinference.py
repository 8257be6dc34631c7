"""The Open Inference Protocol as Triton's own client speaks it, and what a client can get wrong."""

from __future__ import annotations

import json
from collections.abc import Iterator

import numpy as np
import pytest
import tritonclient.http as triton
from tritonclient.utils import InferenceServerException

from service.engine import GarmentEngine
from service.openinference.messages import HEADER_LENGTH

INFER = "/v2/models/shell.tshirt/infer"


@pytest.fixture(scope="module")
def client(url: str) -> Iterator[triton.InferenceServerClient]:
    with triton.InferenceServerClient(url.removeprefix("http://")) as found:
        yield found


def tensors(binary: bool = True, **arrays: np.ndarray) -> list[triton.InferInput]:
    inputs = []
    for name, array in arrays.items():
        inputs.append(triton.InferInput(name, list(array.shape), "FP32"))
        inputs[-1].set_data_from_numpy(array.astype(np.float32), binary_data=binary)
    return inputs


@pytest.fixture(scope="module")
def expected(bundle, motion) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and state straight from the engine."""
    engine = GarmentEngine(bundle.garment("tshirt"))
    return engine.run(motion.poses.astype(np.float32), motion.transl.astype(np.float32), engine.initial_state())


def test_health_and_metadata(client, bundle, http):
    assert client.is_server_live()
    assert client.is_server_ready()
    assert client.is_model_ready("shell.tshirt")
    assert not client.is_model_ready("shell.hat")
    assert "binary_tensor_data" in client.get_server_metadata()["extensions"]
    metadata = client.get_model_metadata("shell.tshirt")
    garment = bundle.garment("tshirt")
    assert metadata["inputs"][0] == {"name": "poses", "datatype": "FP32", "shape": [-1, 55, 3]}
    assert metadata["outputs"][0]["shape"] == [-1, len(garment.mesh.vertices), 3]
    assert metadata["outputs"][1]["shape"] == metadata["inputs"][2]["shape"] == [garment.state_size]
    (version,) = metadata["versions"]
    assert version == http.get("/avatars").json()[0]["version"]
    assert client.is_model_ready("shell.tshirt", version)
    assert client.get_model_metadata("shell.tshirt", version) == metadata
    assert not client.is_model_ready("shell.tshirt", "7")


@pytest.mark.parametrize("binary_in", [True, False])
@pytest.mark.parametrize("binary_out", [True, False])
def test_infers_what_the_engine_does(client, motion, expected, binary_in, binary_out):
    inputs = tensors(binary_in, poses=motion.poses, transl=motion.transl)
    outputs = [triton.InferRequestedOutput(name, binary_data=binary_out) for name in ("vertices", "next_state")]
    result = client.infer("shell.tshirt", inputs, outputs=outputs, request_id="a7")
    np.testing.assert_array_equal(result.as_numpy("vertices"), expected[0])
    np.testing.assert_array_equal(result.as_numpy("next_state"), expected[1])
    answer = result.get_response()
    assert (answer["id"], answer["model_name"]) == ("a7", "shell.tshirt")
    assert answer["model_version"] == client.get_model_metadata("shell.tshirt")["versions"][0]


def test_the_state_continues_a_motion(client, motion, expected):
    first = client.infer("shell.tshirt", tensors(poses=motion.poses[:9], transl=motion.transl[:9]))
    state = first.as_numpy("next_state")
    rest = tensors(poses=motion.poses[9:], transl=motion.transl[9:], state=state)
    version = first.get_response()["model_version"]
    second = client.infer("shell.tshirt", rest, model_version=version)
    joined = np.concatenate([first.as_numpy("vertices"), second.as_numpy("vertices")])
    np.testing.assert_allclose(joined, expected[0], atol=5e-6)


def test_only_the_outputs_asked_for(client, motion):
    inputs = tensors(poses=motion.poses[:2])
    result = client.infer("shell.tshirt", inputs, outputs=[triton.InferRequestedOutput("next_state")])
    assert [output["name"] for output in result.get_response()["outputs"]] == ["next_state"]
    mixed = [triton.InferRequestedOutput("next_state", binary_data=False), triton.InferRequestedOutput("vertices")]
    result = client.infer("shell.tshirt", inputs, outputs=mixed)
    assert result.as_numpy("vertices").shape[0] == 2
    assert result.as_numpy("next_state").ndim == 1


def test_other_frame_rates(client, motion):
    fast = motion.resample(60)
    inputs = tensors(poses=fast.poses, transl=fast.transl)
    result = client.infer("shell.tshirt", inputs, parameters={"fps": 60})
    slow = fast.resample(30)
    expected = client.infer("shell.tshirt", tensors(poses=slow.poses, transl=slow.transl))
    np.testing.assert_allclose(result.as_numpy("vertices"), expected.as_numpy("vertices"), atol=1e-5)


def test_errors_reach_the_client_in_words(client, motion):
    inputs = tensors(poses=motion.poses[:2])
    with pytest.raises(InferenceServerException, match=r"no model 'shell.hat'; there is shell.tshirt, shell.trousers"):
        client.infer("shell.hat", inputs)
    with pytest.raises(InferenceServerException, match="version"):
        client.infer("shell.tshirt", inputs, model_version="7")
    with pytest.raises(InferenceServerException, match="must have 55 joints"):
        client.infer("shell.tshirt", tensors(poses=motion.poses[:2, :24]))
    with pytest.raises(InferenceServerException, match="not be compressed"):
        client.infer("shell.tshirt", inputs, request_compression_algorithm="gzip")
    bad = motion.poses[:4].copy()
    bad[3, 18, 0] = np.nan
    with pytest.raises(InferenceServerException, match=r"frame 3.*left_elbow"):
        client.infer("shell.tshirt", tensors(poses=bad))
    assert client.infer("shell.tshirt", inputs).as_numpy("vertices").shape[0] == 2  # the connection still serves


def test_shared_memory_is_not_offered(client, motion):
    inputs = [triton.InferInput("poses", [2, 55, 3], "FP32")]
    inputs[0].set_shared_memory("region", 2 * 55 * 3 * 4)
    with pytest.raises(InferenceServerException, match=r"shared_memory_region: is not known here"):
        client.infer("shell.tshirt", inputs)


def poses(**changes: object) -> dict[str, object]:
    return {"name": "poses", "shape": [1, 55, 3], "datatype": "FP32", "data": [0.0] * 165, **changes}


HUGE = (1 << 32) - 1
BAD_REQUESTS = [
    ({}, "inputs"),
    ({"inputs": []}, "poses must be among"),
    ({"inputs": [poses(), poses()]}, "twice"),
    ({"inputs": [poses(name="hat")]}, "among poses, transl, state"),
    ({"inputs": [poses(datatype="FP64")]}, "FP32"),
    ({"inputs": [poses(data=[0.0] * 164)]}, "164"),
    ({"inputs": [poses(data=["1"] * 165)]}, "numbers"),
    ({"inputs": [poses(data=[True] * 165)]}, "numbers"),
    ({"inputs": [poses(data=[10**400] * 165)]}, "numbers"),
    ({"inputs": [poses(data=[1e39] * 165)]}, "finite"),
    ({"inputs": [poses(data=[[0.0, 0.0], [0.0]])]}, "equal length"),
    ({"inputs": [poses(shape=[165])]}, "shape"),
    ({"inputs": [poses(shape=[-1, 55, 3])]}, "shape"),
    ({"inputs": [poses(shape=[1 << 31] * 8)]}, "numbers"),
    ({"inputs": [poses(shape=[HUGE, HUGE, 0], data=[])]}, "no array has the shape"),
    (
        {"inputs": [poses(shape=[0, HUGE, HUGE], data=None, parameters={"binary_data_size": 0})]},
        "no array has the shape",
    ),
    ({"inputs": [poses(shape=[HUGE, 55, 0], data=[])]}, "55 joints of 3 numbers"),
    ({"inputs": [poses(parameters={"binary_data_size": 660})]}, "both"),
    ({"inputs": [poses(data=None, parameters={"binary_data_size": 660})]}, "announced"),
    ({"inputs": [poses(data=None, parameters={"binary_data_size": 4})]}, "660"),
    ({"inputs": [poses()], "outputs": [{"name": "normals"}]}, "vertices, next_state"),
    ({"inputs": [poses()], "parameters": {"fps": "x"}}, "fps"),
    ({"inputs": [poses()], "parameters": {"fps": 0}}, "fps"),
    ({"inputs": [poses()], "parameters": {"fps": 10**400}}, "fps"),
    ({"inputs": [poses()], "parameters": {"Fps": 60}}, "parameters.Fps: is not known here"),
    ({"inputs": [poses()], "parameters": {"sequence_id": 7, "sequence_start": True}}, "parameters.sequence_id: is not"),
    ({"inputs": [poses()], "parameters": {"binary_data_output": "true"}}, "parameters.binary_data_output"),
    ({"inputs": [poses()], "outputs": [{"name": "vertices", "parameters": {"classification": 3}}]}, "classification"),
    ({"inputs": [poses()], "bogus": 3}, "bogus: is not known here"),
    ({"inputs": [poses(), poses(name="state", shape=[1], data=[0])]}, "state"),
    ({"inputs": [poses(), poses(name="state", shape=[1, 1], data=[0])]}, "state"),
    ({"inputs": [poses(), poses(name="transl", shape=[2, 3], data=[0] * 6)]}, "transl"),
]


@pytest.mark.parametrize(("body", "word"), BAD_REQUESTS)
def test_bad_requests(http, body, word):
    response = http.post(INFER, content=json.dumps(body))
    assert response.status_code == 400, response.text[:300]
    assert list(response.json()) == ["error"]
    assert word in response.json()["error"]


def test_text_among_numbers_is_not_made_into_an_array(http, monkeypatch):
    """NumPy gives every text as many bytes as the longest: 125 kB became 2 GB."""
    monkeypatch.setattr("service.openinference.messages.np.array", lambda *_: 1 / 0)
    body = {"inputs": [poses(data=["x" * 100_000, *(["a"] * 5000)])]}
    assert "must be numbers" in http.post(INFER, content=json.dumps(body)).json()["error"]


def test_what_kserves_client_says_besides(http):
    asked = {"id": "a", "model_name": "shell.tshirt", "inputs": [poses()]}
    assert http.post(INFER, content=json.dumps(asked)).status_code == 200


@pytest.mark.parametrize("length", ["-1", "x", "999", "1e1", "²", "9" * 40])
def test_bad_header_lengths(http, length):
    body = json.dumps({"inputs": [poses()]})[:-1].encode()
    response = http.post(INFER, content=body[:900], headers={HEADER_LENGTH: length.encode()})
    assert response.status_code == 400
    assert HEADER_LENGTH in response.json()["error"]


def test_bytes_that_nothing_announces(http):
    head = json.dumps({"inputs": [poses()]}).encode()
    response = http.post(INFER, content=head + bytes(8), headers={HEADER_LENGTH: str(len(head))})
    assert response.status_code == 400
    assert "8 bytes are left" in response.json()["error"]


def test_json_answers_are_short(http):
    body = {"inputs": [poses(shape=[200, 55, 3], data=[0] * 33000)]}
    assert http.post(INFER, content=json.dumps(body)).status_code == 413
    body["parameters"] = {"binary_data_output": True}
    response = http.post(INFER, content=json.dumps(body))
    assert response.status_code == 200
    size = int(response.headers[HEADER_LENGTH])
    assert json.loads(response.content[:size])["outputs"][0]["shape"][0] == 200


def test_nested_data_is_flat_data(http):
    nested = poses(data=np.zeros((1, 55, 3)).tolist())
    flat = http.post(INFER, content=json.dumps({"inputs": [poses()]})).json()
    assert http.post(INFER, content=json.dumps({"inputs": [nested]})).json()["outputs"] == flat["outputs"]
