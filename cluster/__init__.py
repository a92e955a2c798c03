"""Putting nodes on ranks, and measuring what that gives.

=======================  ==============================================================
cli                      the command line: one function a command
run, job, pipeline       a run: made ready, and its frame loop on one rank or three
topologies               which there are, how many ranks they take, what they refuse
frame_parallel           each rank draws whole pictures
sort_last, compositing/  each rank draws a share of the points; framebuffers meet
transport, launch        messages between ranks; starting ranks, and who died
delivery                 a scene's arrays sent to the render rank
sink, progress, record   outputs; progress bars; what a run says about itself
scenes, build_ranks      build, synth, info, verify; building on several ranks
layers/                  layer: files → layers of objects
plan/                    what a run needs and what it leaves out; one rank or three
model/                   the parameters and inequalities of the thesis
predict/                 the holistic model: fitted costs, max-plus recurrence
experiment/              grids of runs, resumable, one tidy table
error/                   error against run time
stability/               the suite of stiff and extreme cases
bench/                   rasterizers, builder and pipeline beside others
measured, report         whole runs as measurements; HTML and Markdown reports
=======================  ==============================================================
"""
