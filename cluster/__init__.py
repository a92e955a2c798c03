"""Putting nodes on ranks, and measuring what that gives.

=======================  ==============================================================
cli                      the command line: one function a command
run, job                 a run, made ready
layout, topologies       which rank culls, samples and draws what; what a topology refuses
pipeline, selection      the frame loop of a rank; its part of the octree
coordinator, drawn       starting frames; what ranks say of those they have drawn
compositing/             framebuffers of tiles and shares meet
frame_parallel, film     each rank draws whole pictures; one film of them
wall                     each rank draws and writes a screen of a display wall
transport                messages between ranks; MPI is nowhere else
compression              when messages are coded: measured links, trials
launch, watch            starting ranks; who died, stopped or fell silent
resume, survival         going on with a run cut short, or without a rank that died
delivery                 a scene's arrays sent to the render rank
api, scene_view          the same in Python: open a scene, render cameras
notebook                 a widget that draws with it
selected                 what a job would draw for a camera, and picking in that
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
