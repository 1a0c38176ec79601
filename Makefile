# Each target calls the script of its name in scripts/, which makes .venv and installs what is missing.
.PHONY: help install page demo test test-browser test-containers lock lint format docs benchmark pictures clean

help:
	@echo "make demo       run the whole service on a generated example; results in demo-output/"
	@echo "make test       run every test"
	@echo "make test-browser  only the tests of the web page, in Chromium"
	@echo "make test-containers  build the image, run the cluster and break it (needs a Docker Engine)"
	@echo "make lock       pin the image's dependencies anew (docker/*.lock)"
	@echo "make lint       style, format and types (make format mends what it can)"
	@echo "make page       build the web page, which the service then serves (needs Node.js 20 or later)"
	@echo "make benchmark  the accuracy table, on the data in SMSR_DATA or ../shared/data"
	@echo "make docs       build the documentation into docs/build"
	@echo "make pictures   draw the pictures of the documentation again"
	@echo "make install    only the virtual environment in .venv"
	@echo "make clean      remove .venv and everything generated"

page:
	@scripts/page

install:
	@scripts/install

demo:
	@scripts/demo

test:
	@scripts/test

test-browser:
	@scripts/test-browser

test-containers:
	@scripts/test-containers

lock:
	@scripts/lock

lint:
	@scripts/check

format:
	@scripts/check --fix

benchmark:
	@scripts/benchmark

docs:
	@scripts/docs

pictures:
	@scripts/install dev
	@.venv/bin/python scripts/make_pictures.py

clean:
	rm -rf .venv docs/build docs/generated docs/jupyter_execute service/page/dist service/page/node_modules demo-output .mypy_cache .pytest_cache .ruff_cache .hypothesis
