# shows: a fifth of the pages is run, all are built without a warning; no link is dead, no page too wide
# after: environment tools
# cores: 2
# minutes: 25
part="$((TURN % 5 + 1))/5"
pages=$(python docs/part.py "$part" | xargs)
QUELL_DOCS_PART=$part sphinx-build -j 2 -W --keep-going -q -b html docs "$OWN/site"
test "$(ls "$OWN"/site/_images/*.png | wc -l)" -ge 5 || { echo "the pages have lost their pictures"; exit 1; }
python docs/check_links.py "$OWN/site"
for text in llms.txt reference.md setup.schema.json; do test -s "$OWN/site/$text" || { echo "the site has no $text"; exit 1; }; done
if command -v clang >/dev/null && command -v wasm-ld >/dev/null; then
    test -s "$OWN/site/_static/moving.js" || { echo "the pages have lost the loop that moves"; exit 1; }
fi
if grep -rl "&lt;Figure size" "$OWN/site" --include="*.html"; then echo "these pages show a picture as text"; exit 1; fi
python docs/check_pages.py "$OWN/site" $pages
