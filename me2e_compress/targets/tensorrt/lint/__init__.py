"""Lint rules: does TensorRT's parser accept a graph, and is its int8 run as int8?"""
