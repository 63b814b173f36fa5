"""The rewriting kit: safe edits of a graph, and fusions written as patterns.

Every edit keeps the interface: an output that is replaced keeps its name, and an edit
that would need to change an input or output is refused. New nodes inherit the module
and the origins of those they replace, and name the pass that made them.
"""

from me2e_compress.graph.rewrite.edits import add_constant as add_constant
from me2e_compress.graph.rewrite.edits import bypass as bypass
from me2e_compress.graph.rewrite.edits import can_replace as can_replace
from me2e_compress.graph.rewrite.edits import fresh_name as fresh_name
from me2e_compress.graph.rewrite.edits import lift_constants as lift_constants
from me2e_compress.graph.rewrite.edits import put as put
from me2e_compress.graph.rewrite.edits import remove_dead as remove_dead
from me2e_compress.graph.rewrite.edits import remove_node as remove_node
from me2e_compress.graph.rewrite.edits import remove_unread as remove_unread
from me2e_compress.graph.rewrite.edits import replace_value as replace_value
from me2e_compress.graph.rewrite.edits import sweep as sweep
from me2e_compress.graph.rewrite.edits import value_names as value_names
from me2e_compress.graph.rewrite.fusion import Facts as Facts
from me2e_compress.graph.rewrite.fusion import Fused as Fused
from me2e_compress.graph.rewrite.fusion import Fusion as Fusion
from me2e_compress.graph.rewrite.fusion import Kit as Kit
from me2e_compress.graph.rewrite.fusion import fuse as fuse
from me2e_compress.graph.rewrite.pattern import Match as Match
from me2e_compress.graph.rewrite.pattern import Pattern as Pattern
from me2e_compress.graph.rewrite.pattern import constant as constant
from me2e_compress.graph.rewrite.pattern import either as either
from me2e_compress.graph.rewrite.pattern import match as match
from me2e_compress.graph.rewrite.pattern import op as op
from me2e_compress.graph.rewrite.pattern import var as var
