"""What an encoder is shown, and how its vectors are compared: which finds places again. `python -m bench.places`."""
