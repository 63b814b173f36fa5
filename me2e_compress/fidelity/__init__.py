"""How far a graph is from another, and which modules and nodes int8 hurts."""

# Least SQNR of an output, dB: noise of a tenth of the signal's amplitude
SQNR_FLOOR_DB = 20.0
# Least standard deviation over frames, as a share of the uncompressed graph's, of an
# output that is not dead
ALIVE = 0.01
