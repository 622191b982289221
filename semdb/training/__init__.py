"""Training and evaluation of detectors on COCO-format data. Needs the extra ``torch``; imports it inside functions."""
