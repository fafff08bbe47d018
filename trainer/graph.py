"""ONNX graphs: export a network, quantise it, run it, and read and write the embedded contract."""

from __future__ import annotations

import os
import tempfile
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import onnx
import onnxruntime as ort
import torch
from onnxruntime.quantization import CalibrationDataReader, CalibrationMethod, QuantFormat, QuantType, quantize_static
from onnxruntime.quantization.shape_inference import quant_pre_process

from msgs.contract import INPUT_NAMES, METADATA_KEY, OUTPUT_NAMES, ModelContract
from trainer.backbones import fuse_branches
from trainer.bias_correction import correct_biases
from trainer.config import ConfigError
from trainer.data import TrainingBatch
from trainer.evaluate import Predictions, Predictor
from trainer.half_storage import store_halved
from trainer.heads import BESIDE_MOST
from trainer.image_input import drop_unread, feed_pixels, fold_normalisation, quantised_as_pixels
from trainer.model import PoseNet
from trainer.pixel_quads import take_quads
from trainer.tally import Tally, windows_in
from trainer.unfinished import unfinished

OPSET = 17
THREADS = 2
ORT_WARNING, ORT_ERROR = 2, 3  # severities of its log; the first is its default
QUANTISED_OPS = ["Conv", "Gemm", "Add", "Concat", "Resize", "Mul", "Relu", "Clip"]
# Soft-argmax, ray, sampling, depth and rotation remain in float, and so does the last layer of each head.
QUANTISED_PARTS = (
    "/backbone/",
    "/neck/",
    "/head_hm/head_hm.0/",
    "/dts/convs/",
    "/dts/region/",
    "/fuse_t/context/",
    "/fuse_r/context/",
    "/head_refine/convs/",
    "/head_choice/convs/",
    "/head_presence/convs/",
    *(f"/head_presence/beside.{i}/convs/" for i in range(BESIDE_MOST)),
)


def write_graph(model: PoseNet, path: Path) -> None:
    """Write the network as ONNX with msgs.contract's inputs and outputs; N, H and W are dynamic. Raises ConfigError."""
    image = torch.randint(0, 255, (2, 128, 192, 3), dtype=torch.uint8)
    K = torch.tensor([[900.0, 0, 96], [0, 900, 64], [0, 0, 1]]).repeat(2, 1, 1)
    free = {"image": {0: "N", 1: "H", 2: "W"}, "K": {0: "N"}, **{name: {0: "N"} for name in OUTPUT_NAMES}}
    with warnings.catch_warnings(), torch.no_grad():
        warnings.simplefilter("ignore")  # the tracer warns about shapes that it traces correctly
        try:
            torch.onnx.export(
                fuse_branches(model),
                (image, K),
                str(path),
                input_names=list(INPUT_NAMES),
                output_names=list(OUTPUT_NAMES),
                dynamic_axes=free,
                opset_version=OPSET,
                dynamo=False,
            )
        except OSError as error:
            raise ConfigError(f"{path}: cannot be written: {error.strerror}") from error


def _one_by_one(batches: list[TrainingBatch], what: str, say: Callable[[str], None]) -> Iterator[dict[str, np.ndarray]]:
    """The graph's inputs, one image at a time; `what` is said to be done with them."""
    tally = Tally(what, windows_in(batches), say)
    for batch in batches:
        for image, K in zip(batch.image_bgr, batch.K, strict=True):
            yield {"image": image[None], "K": K[None]}
            tally.add(1)


class _Inputs(CalibrationDataReader):
    def __init__(self, inputs: Iterator[dict[str, np.ndarray]]) -> None:
        self._inputs = inputs

    def get_next(self) -> dict[str, np.ndarray] | None:
        return next(self._inputs, None)


def fold_pads(graph: onnx.GraphProto) -> None:
    """Merge each zero Pad into the convolution after it: between INT8 layers, a Pad would remain in float."""
    constants = {tensor.name: onnx.numpy_helper.to_array(tensor) for tensor in graph.initializer}
    users = Counter(name for node in graph.node for name in node.input)
    pads = {node.output[0]: node for node in graph.node if node.op_type == "Pad" and users[node.output[0]] == 1}
    for conv in list(graph.node):
        pad = pads.get(conv.input[0]) if conv.op_type == "Conv" else None
        if pad is None or pad.input[1] not in constants or any(constants.get(name, 0.0) for name in pad.input[2:3]):
            continue
        before_n_c_h_w, after_n_c_h_w = np.split(constants[pad.input[1]], 2)
        attribute = next(a for a in conv.attribute if a.name == "pads")
        added = [*before_n_c_h_w[2:], *after_n_c_h_w[2:]]
        attribute.ints[:] = [int(old + new) for old, new in zip(attribute.ints, added, strict=True)]
        conv.input[0] = pad.input[0]
        graph.node.remove(pad)
    drop_unread(graph)


@contextmanager
def _errors_alone() -> Iterator[None]:
    """ONNX Runtime without its warnings, on graphs that we are still changing."""
    ort.set_default_logger_severity(ORT_ERROR)
    try:
        yield
    finally:
        ort.set_default_logger_severity(ORT_WARNING)


@_errors_alone()
def quantise_graph(
    source: Path, destination: Path, calibration: list[TrainingBatch], say: Callable[[str], None]
) -> None:
    """Static INT8: QDQ, U8 activations, S8 weights per channel, calibrated on `calibration`, biases corrected on it.

    Layers that remain in float have their weights stored in half precision. `say` is told how far it has come.
    """
    with tempfile.TemporaryDirectory() as folder:
        prepared = Path(folder) / "prepared.onnx"
        quant_pre_process(str(source), str(prepared), skip_symbolic_shape=True)
        prepared_model = onnx.load(str(prepared))
        fold_pads(prepared_model.graph)
        stem_input = fold_normalisation(prepared_model.graph, INPUT_NAMES[0])
        onnx.save(prepared_model, str(prepared))
        ours = [node for node in prepared_model.graph.node if node.name.startswith(QUANTISED_PARTS)]
        nodes = [node.name for node in ours if node.op_type in QUANTISED_OPS]
        quantize_static(
            str(prepared),
            str(destination),
            _Inputs(_one_by_one(calibration, "quantising", say)),
            quant_format=QuantFormat.QDQ,
            op_types_to_quantize=QUANTISED_OPS,
            nodes_to_quantize=nodes,
            per_channel=True,
            activation_type=QuantType.QUInt8,
            weight_type=QuantType.QInt8,
            calibrate_method=CalibrationMethod.MinMax,
            extra_options={
                "QDQKeepRemovableActivations": False,
                "TensorQuantOverrides": quantised_as_pixels(stem_input),
            },
        )
    quantised = onnx.load(str(destination))
    correct_biases(quantised, prepared_model.graph, _one_by_one(calibration, "correcting biases", say))
    feed_pixels(quantised.graph, INPUT_NAMES[0])
    take_quads(quantised.graph, INPUT_NAMES[0])
    store_halved(quantised.graph)
    onnx.save(quantised, str(destination))


def write_contract(path: Path, contract: ModelContract) -> None:
    """Write the contract into the model file's metadata. Raises ConfigError on failure, with the file unchanged."""
    path = path.resolve()  # replaces the target of a symbolic link, not the link
    model = onnx.load(str(path))
    onnx.helper.set_model_props(model, {METADATA_KEY: contract.model_dump_json()})
    try:
        with unfinished(path) as part:
            with part.open("wb") as file:
                file.write(model.SerializeToString())
                file.flush()
                os.fsync(file.fileno())
            part.chmod(path.stat().st_mode)
    except OSError as error:
        raise ConfigError(f"{path}: cannot be written: {error.strerror}") from error


def read_contract(path: Path) -> ModelContract:
    """The contract in a model file. Raises ConfigError naming the file."""
    if not path.is_file():
        raise ConfigError(f"{path}: no such model file")
    try:
        model = onnx.load(str(path), load_external_data=False)  # a session is much slower
    except Exception as error:
        raise ConfigError(f"{path}: not an ONNX model: {error}") from None
    metadata = {entry.key: entry.value for entry in model.metadata_props}
    if METADATA_KEY not in metadata:
        raise ConfigError(f"{path}: has no {METADATA_KEY} metadata: not a model of this program")
    try:
        return ModelContract.model_validate_json(metadata[METADATA_KEY])
    except ValueError as error:
        raise ConfigError(f"{path}: {METADATA_KEY}: {error}") from None


def open_session(path: Path) -> ort.InferenceSession:
    """An ONNX Runtime session on the CPU. Raises ConfigError if the file is no model."""
    if not path.is_file():
        raise ConfigError(f"{path}: no such model file")
    options = ort.SessionOptions()
    options.intra_op_num_threads = THREADS
    options.log_severity_level = ORT_ERROR
    try:
        return ort.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    except Exception as error:
        raise ConfigError(f"{path}: ONNX Runtime cannot load it: {str(error).splitlines()[0]}") from None


def onnx_predictor(path: Path) -> Predictor:
    """A predictor that runs a model file in ONNX Runtime."""
    session = open_session(path)

    def predict(image_bgr: np.ndarray, K: np.ndarray) -> Predictions:
        outputs = session.run(list(OUTPUT_NAMES), {"image": image_bgr, "K": K})
        return Predictions(*(value[:, 0] for value in outputs))

    return predict
