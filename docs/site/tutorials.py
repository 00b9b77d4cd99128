"""The tutorials: notebooks that mkdocs-jupyter executes, each in an empty folder, and whose pages are kept.

mkdocs-jupyter keeps an executed page until its notebook changes. As a hook of mkdocs this also executes it anew when
jeit or a library beneath has changed: pages stand in `.cache/tutorials`, in a folder for each version of the code.
While pages are written, JEIT_GALLERY=kept takes those that older code made.
"""

import os
import re
import shutil

import gallery

CACHE = gallery.ROOT / ".cache" / "tutorials"
IPYTHON = gallery.ROOT / ".cache" / "ipython"
# A kernel starts in the folder of its notebook, and would leave there what the notebook writes.
_KERNEL = """c.IPKernelApp.exec_lines = [
    "import os as _os, tempfile as _tempfile",
    "_folder = _tempfile.TemporaryDirectory(); _os.chdir(_folder.name)",
]
"""


def on_config(config):
    """Choose where pages are kept, remove those of other code, and let kernels start in an empty folder."""
    folder = CACHE / ("kept" if os.environ.get("JEIT_GALLERY") == "kept" else gallery.code()[:16])
    for old in CACHE.glob("*"):
        if old.name not in (folder.name, "kept"):
            shutil.rmtree(old)
    config.plugins["mkdocs-jupyter"].config["cache_dir"] = str(folder)
    profile = IPYTHON / "profile_default"
    profile.mkdir(parents=True, exist_ok=True)
    (profile / "ipython_kernel_config.py").write_text(_KERNEL, "utf-8")
    os.environ["IPYTHONDIR"] = str(IPYTHON)
    return config


def on_page_markdown(markdown, page, config, files):
    """Take out the style sheet that mkdocs-jupyter leaves at the end of a notebook, which would be shown as text."""
    return re.sub(r"^ *<style>\s*\[.*?</style>", "", markdown, flags=re.DOTALL | re.MULTILINE)


def on_page_content(html, page, config, files):
    """Begin a tutorial with a link that downloads its notebook, which stands beside the page."""
    name = page.file.src_uri.rpartition("/")[2]
    return f'<p><a href="{name}" download>Download this notebook</a></p>\n{html}' if name.endswith(".ipynb") else html


def on_post_page(output, page, config):
    """Take out the script that loads MathJax from the network: formulas here are plain text."""
    return re.sub(r"<script data-mkdocs-jupyter-mathjax=.*?</script>", "", output, flags=re.DOTALL)
