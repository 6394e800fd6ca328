"""Range images ⇄ a compressed file, losslessly once ranges are rounded to a step, by a model's pixel decoder.

A coder and a decoder must compute the same probabilities, to the last bit, on different machines. Three things see to
it. The networks run in 64 bits, where machines differ by less than 1e-11, and what they give is rounded to coarse
grids; pixels of which a number lies so near to a border that another machine might round it the other way are rounded
with shifted borders. From the rounded numbers on, only operations are used whose results IEEE 754 fixes. And a
scan carries a checksum of its pixels, so that any other error is detected before a wrong file is written.
"""
