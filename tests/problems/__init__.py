"""Problems with known answers, for tests, benchmarks and notebooks alike.

`closed_form` has single scenes for unit tests. `CASES` is the catalogue of complete problems: by name, a scene of any size,
what to read out of its solution, what is expected, how well that is known, and the errors aimed at (`case.Case`).
"""

from types import MappingProxyType

from . import enclosures, media, rendered
from .case import Case as Case
from .case import Readings as Readings
from .case import Target as Target
from .case import readings as readings
from .closed_form import *  # noqa: F403
from .data import probes as probes
from .data import table as table
from .data import top_view as top_view
from .rendered import in_blocks as in_blocks
from .rendered import read_picture as read_picture
from .rendered import spread_blocks as spread_blocks

CASES = MappingProxyType({case.name: case for case in (*media.CASES, *enclosures.CASES, *rendered.CASES)})
