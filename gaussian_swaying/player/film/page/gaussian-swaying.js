// <gaussian-swaying src="flag.html" wind="4,0,0" view="0,-2,0,0,0,0"></gaussian-swaying>: a page of export --live-web, or a .sway file,
// within another page.
// Attributes, besides src: wind (x, y and z, m/s), gusts, stiffness and speed (1 as in the page), view (place of the camera, and what it
// looks at), and solver (webgpu or worker), as in the link that the page's button copies.
(() => {
  const beside = document.currentScript.src.replace(/[^/]*$/, ""); // where player.html lies
  const SETTINGS = ["wind", "gusts", "stiffness", "speed", "view", "solver"];

  class GaussianSwaying extends HTMLElement {
    static observedAttributes = ["src", ...SETTINGS];

    connectedCallback() {
      if (this.frame) return;
      this.frame = document.createElement("iframe");
      this.frame.title = this.title || "An object in the wind";
      this.frame.allow = "clipboard-write";
      Object.assign(this.frame.style, { width: "100%", height: "100%", border: "0", display: "block" });
      if (!this.style.display) this.style.display = "block";
      if (!this.style.height && this.clientHeight === 0) this.style.height = "480px";
      this.append(this.frame);
      this.open();
    }

    get settings() {
      const given = SETTINGS.filter((name) => this.hasAttribute(name));
      return given.map((name) => `${name}=${encodeURIComponent(this.getAttribute(name))}`).join("&");
    }

    open() {
      const src = this.getAttribute("src");
      const film = `${beside}player.html?src=${encodeURIComponent(new URL(src, document.baseURI).href)}`;
      this.frame.src = `${/\.sway($|\?)/.test(src) ? film : src}#${this.settings}`;
    }

    attributeChangedCallback(name) {
      if (!this.frame) return;
      if (name === "src") this.open();
      else this.frame.contentWindow?.postMessage({ gaussianSwaying: this.settings }, "*");
    }
  }

  customElements.define("gaussian-swaying", GaussianSwaying);
})();
