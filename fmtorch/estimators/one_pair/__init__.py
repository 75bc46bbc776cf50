"""The kernel form of the engine's parts: NumPy arrays of one pair, loops over them compiled.

Each part is made of its tensor form, whose options it reads, and computes the same: samples are the same number by
number, models and scores up to rounding. A pair has no padding and no neighbours here. `registry` says which parts
have this form.
"""
