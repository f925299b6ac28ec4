"""The settings of one gateway."""

from dataclasses import dataclass

from daedalus.gateway.errors import ClientError
from daedalus.protocol import keys


@dataclass(frozen=True, slots=True, kw_only=True)
class GatewayConfig:
    """What a gateway decides for itself."""

    name: str  # of its own requests; it is no actor
    owner: str = ""  # the name in its certificate: clients are OWNER.NAME to the learner; empty without a certificate
    run: str = keys.ANY_RUN

    def actor_name(self, client: str) -> str:
        """Return the name of a client towards the learner. Raises ClientError if there is none."""
        name = f"{self.owner}.{client}" if self.owner else client
        if not keys.is_name(client) or not keys.is_name(name):
            raise ClientError(
                "malformed",
                f"name must be 1 to {64 - len(name) + len(client)} letters, digits, '.', '_' or '-', starting with a "
                "letter or digit",
            )
        return name
