"""Whether tests do in full what an ordinary run does in part: `make test WHOLE=1`."""

import os

WHOLE = os.environ.get("AQUALVS_WHOLE", "") not in ("", "0")
