"""Class names of COCO as detectors number them."""

from __future__ import annotations

_NAMES = """
background|person|bicycle|car|motorcycle|airplane|bus|train|truck|boat|traffic light|fire hydrant|N/A|stop sign
parking meter|bench|bird|cat|dog|horse|sheep|cow|elephant|bear|zebra|giraffe|N/A|backpack|umbrella|N/A|N/A
handbag|tie|suitcase|frisbee|skis|snowboard|sports ball|kite|baseball bat|baseball glove|skateboard|surfboard
tennis racket|bottle|N/A|wine glass|cup|fork|knife|spoon|bowl|banana|apple|sandwich|orange|broccoli|carrot|hot dog
pizza|donut|cake|chair|couch|potted plant|bed|N/A|dining table|N/A|N/A|toilet|N/A|tv|laptop|mouse|remote|keyboard
cell phone|microwave|oven|toaster|sink|refrigerator|N/A|book|clock|vase|scissors|teddy bear|hair drier|toothbrush
"""

COCO_91 = tuple(_NAMES.strip().replace("\n", "|").split("|"))
"""The 91 names by category id; ``background`` at 0, ``N/A`` at the ids that COCO leaves out."""

NO_OBJECT = frozenset({"N/A", "background", "__background__"})
"""Names in a model's list of classes that stand for no object."""

_INDOOR = """
backpack|bed|bench|book|bottle|bowl|cell phone|chair|clock|couch|cup|dining table|handbag|keyboard|laptop
microwave|mouse|oven|potted plant|refrigerator|remote|scissors|sink|suitcase|teddy bear|toaster|toilet|tv
umbrella|vase|wine glass
"""

INDOOR = tuple(_INDOOR.strip().replace("\n", "|").split("|"))
"""The indoor subset of COCO's classes: what stands or lies in a room for longer than a moment."""
