"""Every OpenCL kernel: one file per stage, with the stem of its host file in server/stages and of its test."""
