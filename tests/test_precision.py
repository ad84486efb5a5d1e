import pytest
import torch

from torchrl_rad.precision import planning_dtype, uses_bf16


@pytest.mark.parametrize("amx", [False, True])
def test_bf16_where_it_is_faster(monkeypatch, amx):
    monkeypatch.setattr(torch.cpu, "_is_amx_tile_supported", lambda: amx, raising=False)
    assert uses_bf16("auto") is amx
    assert uses_bf16("auto", torch.device("cpu")) is amx
    assert uses_bf16("bf16") is True
    assert uses_bf16("fp32") is False


@pytest.mark.parametrize("supported", [False, True])
def test_bf16_on_cuda(monkeypatch, supported):
    monkeypatch.setattr(torch.cuda, "is_bf16_supported", lambda: supported)
    assert uses_bf16("auto", "cuda:0") is supported


def test_unknown_processor_trains_in_float32(monkeypatch):
    monkeypatch.delattr(torch.cpu, "_is_amx_tile_supported", raising=False)
    assert uses_bf16("auto") is False


def test_unknown_precision():
    with pytest.raises(ValueError, match="precision is 'fp8'; expected 'auto', 'bf16' or 'fp32'"):
        uses_bf16("fp8")


@pytest.mark.parametrize(
    "amx, packs, expected",
    [
        (True, True, torch.bfloat16),
        (False, True, torch.float16),
        (False, False, None),
    ],
)
def test_a_decision_is_made_in_what_is_fast(monkeypatch, amx, packs, expected):
    monkeypatch.setattr(torch.cpu, "_is_amx_tile_supported", lambda: amx, raising=False)
    monkeypatch.setattr("torchrl_rad.precision.can_pack", lambda dtype: packs)
    assert planning_dtype("auto") is expected
    assert planning_dtype("bf16") is torch.bfloat16
    assert planning_dtype("fp16") is torch.float16
    assert planning_dtype("fp32") is None


def test_packed_weights_are_for_cpus(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_bf16_supported", lambda: False)
    assert planning_dtype("auto", "cuda") is None


def test_a_decision_in_an_unknown_precision():
    with pytest.raises(ValueError, match="precision is 'fp8'"):
        planning_dtype("fp8")


if __name__ == "__main__":
    raise SystemExit(pytest.main([__file__]))
