"""Metrics by the names of their classes."""

import pytest

from lidargrit.evaluation import metrics
from lidargrit.evaluation.metrics import load_metric


def test_a_metric_is_imported_by_the_name_of_its_class():
    from lidargrit.evaluation.metrics import SlicedWasserstein

    assert SlicedWasserstein is load_metric("sliced_wasserstein")
    with pytest.raises(ImportError, match="SlicedWassertein"):
        from lidargrit.evaluation.metrics import SlicedWassertein  # noqa: F401
    assert not hasattr(metrics, "sliced_wasserstien")
