"""Graphs: read, write, measure and compare them.

The in-memory form is ``onnx_ir.Model``; these few words are all that the rest of the
package says about it, besides walking nodes and values.
"""

from me2e_compress.graph.digest import digest as digest
from me2e_compress.graph.files import file_bytes as file_bytes
from me2e_compress.graph.files import load as load
from me2e_compress.graph.files import save as save
from me2e_compress.graph.files import sha256_of as sha256_of
from me2e_compress.graph.nodes import array_of as array_of
from me2e_compress.graph.nodes import graphs_of as graphs_of
from me2e_compress.graph.nodes import has_subgraph as has_subgraph
from me2e_compress.graph.nodes import input_at as input_at
from me2e_compress.graph.nodes import is_standard as is_standard
from me2e_compress.graph.nodes import nodes_of as nodes_of
from me2e_compress.graph.nodes import opset_of as opset_of
from me2e_compress.graph.nodes import producer_of as producer_of
from me2e_compress.graph.shapes import CONVOLUTIONS as CONVOLUTIONS
from me2e_compress.graph.shapes import WEIGHTED as WEIGHTED
from me2e_compress.graph.shapes import bias_of as bias_of
from me2e_compress.graph.shapes import channel_axis as channel_axis
from me2e_compress.graph.shapes import infer_shapes as infer_shapes
from me2e_compress.graph.shapes import rank_of as rank_of
from me2e_compress.graph.shapes import static_shape as static_shape
from me2e_compress.graph.summary import interface as interface
from me2e_compress.graph.summary import macs as macs
from me2e_compress.graph.summary import node_count as node_count
from me2e_compress.graph.summary import size as size
