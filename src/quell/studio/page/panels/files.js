// The setup as text, and files: saved, opened, exported.

import { home } from "../dom.js";

export class Files {
  // `ask(message)` sends with the present setup; `open(text, models)` opens the texts of files.
  constructor(ask, open) {
    Object.assign(this, { ask, texts: null, saving: false });
    home("save").onclick = () => this.askText(true);
    home("show-text").onclick = () => this.askText(false);
    home("export-c").onclick = () => this.askExport("c");
    home("export-fmu").onclick = () => this.askExport("fmu");
    home("open").onclick = () => home("file").click();
    home("file").onchange = async () => {
      const found = await setupOf([...home("file").files]);
      home("file").value = "";
      if (found) open(...found);
      else home("state").textContent = "Choose one setup (.toml), and the file of its identified model (.json) if it has one.";
    };
    home("as-toml").onclick = () => this.choose("toml");
    home("as-python").onclick = () => this.choose("python");
    home("copy").onclick = async () => {
      await navigator.clipboard.writeText(home("text").textContent);
      home("copy").textContent = "Copied";
    };
    home("close-texts").onclick = () => home("texts").close();
  }

  askText(saving) {
    this.saving = saving;
    this.ask({ do: "toml" });
  }

  askExport(to) {
    home("state").textContent = "translating to C …";
    this.ask({ do: "export", to });
  }

  // Take the texts of the setup with a title: show them, or save the TOML.
  take(texts, title) {
    if (this.saving) {
      this.saving = false;
      const name = title.toLowerCase().replaceAll(/[^a-z0-9]+/g, "_") || "setup";
      download(`${name}.toml`, new TextEncoder().encode(texts.toml));
      return;
    }
    this.texts = texts;
    this.choose("toml");
    home("texts").showModal();
  }

  choose(which) {
    home("text").textContent = this.texts[which];
    home("as-toml").setAttribute("aria-pressed", which === "toml");
    home("as-python").setAttribute("aria-pressed", which === "python");
    home("copy").textContent = "Copy";
  }
}

export function download(name, content) {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(new Blob([content]));
  link.download = name;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 10_000);
}

// Return the text of a setup file and those of models beside it by name; null for other files.
export async function setupOf(files) {
  const setups = files.filter((file) => !/\.json$/i.test(file.name));
  if (setups.length !== 1) return null;
  const models = files.filter((file) => file !== setups[0]);
  const texts = await Promise.all(models.map(async (file) => [file.name, await file.text()]));
  return [await setups[0].text(), Object.fromEntries(texts)];
}
