"""Orders of an operator to the learner."""

from dataclasses import dataclass
from typing import Literal

Order = Literal["stop", "checkpoint"]


@dataclass(frozen=True, slots=True, kw_only=True)
class OrderRequest:
    """Order of an operator. Operator -> learner, on `orders`. The answer is an Acknowledgement `accepted`.

    stop: save a checkpoint and end; the run can be resumed.
    checkpoint: save a checkpoint now.
    """

    order: Order
