"""Wrong tokens are counted, and no further ones are heard of an address that tries many.

What is counted is different wrong tokens: a forgotten script that repeats an old one is no guessing. Known
tokens are never asked about here, so that a guesser shuts out nobody who shares its address. What keeps
guessing hopeless is a token's 256 random bits; this keeps it rare and known.
"""

from __future__ import annotations

import ipaddress
from collections import OrderedDict

WINDOW_S = 60.0
MOST_OF_ONE = 10  # different wrong tokens from one address in a window
MOST_OF_ALL = 100  # from all; then no wrong one is heard from any address that gave one
MOST_ADDRESSES = 1000


def neighbourhood(address: str) -> str:
    """Return what counts as one address: of IPv6 the network of 64 bits, in which one may choose freely."""
    try:
        parsed = ipaddress.ip_address(address.partition("%")[0])
    except ValueError:
        return address
    if isinstance(parsed, ipaddress.IPv4Address):
        return str(parsed)
    if parsed.ipv4_mapped is not None:
        return str(parsed.ipv4_mapped)
    return str(ipaddress.ip_network((parsed, 64), strict=False).network_address)


class Guesses:
    """The wrong tokens of the last minute; used on one thread. Times are seconds of any clock."""

    def __init__(self) -> None:
        self._wrong: OrderedDict[str, dict[str, float]] = OrderedDict()  # address: digest: when first

    def wait_s(self, address: str, now_s: float) -> float:
        """Return how long an address is not heard yet, seconds; 0.0 if it is heard."""
        self._forget(now_s)
        own = self._wrong.get(neighbourhood(address), {})
        if not own:
            return 0.0
        if len(own) < MOST_OF_ONE and sum(map(len, self._wrong.values())) < MOST_OF_ALL:
            return 0.0
        return max(0.0, min(own.values()) + WINDOW_S - now_s)

    def wrong(self, address: str, digest: str, now_s: float) -> bool:
        """Take note of a wrong token; return whether it is this address's first in the window."""
        self._forget(now_s)
        address = neighbourhood(address)
        first = address not in self._wrong
        self._wrong.setdefault(address, {}).setdefault(digest, now_s)
        while len(self._wrong) > MOST_ADDRESSES:
            self._wrong.popitem(last=False)
        return first

    def _forget(self, now_s: float) -> None:
        for address, digests in list(self._wrong.items()):
            for digest in [one for one, at_s in digests.items() if now_s - at_s >= WINDOW_S]:
                del digests[digest]
            if not digests:
                del self._wrong[address]
