#!/usr/bin/env bash
# Builds the site of the documentation; warnings are errors. The first page is build/docs/index.html.
#
# usage: scripts/docs.sh [FOLDER]      default: build/docs
set -euo pipefail

bash "$(dirname "${BASH_SOURCE[0]}")/setup.sh" --dev
source "$(dirname "${BASH_SOURCE[0]}")/environment.sh"
cd "$root"
folder=${1:-build/docs}
"$python" -m sphinx -W --keep-going -n -q -b html -d "$folder/.doctrees" -c docs . "$folder"
echo "docs: $folder/index.html"
