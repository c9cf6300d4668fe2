"""A server with fake pipelines, as a program for a process of its own."""

SERVE_FAKE = """
import sys
from server.service.serve import listen, serve_on
from server.service.service import Service
from tests.service.fakes import FAKE_DEVICE, Lab, fake_mesh

service = Service(FAKE_DEVICE, pipeline_factory=Lab().build, mesh_loader=fake_mesh)
sys.exit(serve_on(listen("127.0.0.1", 0), service, lambda line: print(line, flush=True)))
"""
