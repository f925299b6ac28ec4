"""Messages about the metrics of a run: their history, page by page, for an operator who watches it."""

from dataclasses import dataclass

import numpy as np

from daedalus.protocol.specification import Specification

MAX_PAGE_VALUES = 1 << 16  # numbers in one page


class MetricsPage(Specification):
    """What the numbers of a MetricsReport mean."""

    run: str
    learner_epoch: int
    columns: tuple[str, ...]  # names of the metrics, as in metrics.csv


@dataclass(frozen=True, slots=True, kw_only=True)
class MetricsRequest:
    """Request of an operator for rows of the metrics. Operator -> learner, on `status`."""

    first: int  # number of the first row wanted; 0: from the begin of the run


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MetricsReport:
    """The next rows of the metrics, in answer to a MetricsRequest; no rows after the newest.

    The learner keeps a bounded number of rows of the whole run. Therefore numbers are missing among older rows.
    """

    page: MetricsPage
    numbers: np.ndarray  # [rows] int64, increasing
    values: np.ndarray  # [rows, columns] float64; NaN where a row has no value

    def __post_init__(self) -> None:
        if self.numbers.ndim != 1 or self.numbers.dtype != np.int64:
            raise ValueError(f"numbers must be int64 [rows], not {self.numbers.dtype} {self.numbers.shape}")
        shape = (len(self.numbers), len(self.page.columns))
        if self.values.shape != shape or self.values.dtype != np.float64:
            raise ValueError(f"values must be float64 {list(shape)}, not {self.values.dtype} {self.values.shape}")
