import pytest

from torchrl_rad.retrieval import search


@pytest.fixture(scope="module", params=[0, search.FEW_ENTRIES], ids=["float32", "float64"])
def compared_in(request):
    """Rows compared in float32, as many are, and in float64, as few are."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(search, "FEW_ENTRIES", request.param)
        yield
