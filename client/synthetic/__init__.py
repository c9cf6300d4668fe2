"""Analytic scenes with exact ground truth: closed-form intersections and light, shadows by quadrature.

Independent of OpenCL and of the server, because the pipeline is tested against these scenes.
"""
