"""Every OpenCL kernel: one file a stage, with the folder and the stem of its host file in server/.

Its test is tests/kernels/test_<stem>.py. Device functions that several kernels share are in include/.
"""
