// What the page is busy with, in one place: loading, an error, or a service that went away.

const find = (id) => document.getElementById(id);

export class PageState {
  constructor({ again, dismiss, key }) {
    this.card = find("state");
    find("again").addEventListener("click", again);
    find("dismiss").addEventListener("click", dismiss);
    find("key-form").addEventListener("submit", (event) => {
      event.preventDefault();
      key(find("key").value);
    });
    find("rate-form").addEventListener("submit", (event) => {
      event.preventDefault();
      this.rateGiven(Number(find("fps").value));
    });
    this.clear();
  }

  get kind() { return this.card.hidden ? "" : this.card.dataset.kind; }

  loading(text) { this.set("loading", text); }

  /** Disconnected, and trying again by itself. */
  gone(text) { this.set("gone", text); }

  /** `back` says whether there is something to go back to. */
  error(text, { back = false, again = true } = {}) {
    this.set("error", text);
    find("dismiss").hidden = !back;
    find("again").hidden = !again;
    (back ? find("dismiss") : find("again")).focus();
  }

  askForKey(text) {
    this.set("key", text);
    find("key-form").hidden = false;
    find("key").focus();
  }

  /** Below an error: the frame rate of the file may be what is missing. */
  offerRate(given) {
    this.rateGiven = given;
    find("rate-form").hidden = false;
  }

  clear() { this.card.hidden = true; }

  set(kind, text) {
    this.card.hidden = false;
    this.card.dataset.kind = kind;
    find("state-text").textContent = text;
    find("key-form").hidden = find("rate-form").hidden = true;
  }
}
