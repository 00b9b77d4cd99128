// Pictures and films of the image, which the browser creates and saves as downloads, without the server.

const LONGEST_FILM = 10 * 60 * 1000;
const TYPES = ["video/webm;codecs=vp9", "video/webm;codecs=vp8", "video/webm", "video/mp4"];

function name(ending) {
  const now = new Date(Date.now() - 60000 * new Date().getTimezoneOffset());
  return `jeit-${now.toISOString().slice(0, 19).replace("T", "-").replaceAll(":", "")}.${ending}`;
}

function download(blob, ending) {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(blob);
  link.download = name(ending);
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 60000);
  return link.download;
}

// `done` is called with the name of the saved picture, or null if the browser creates none.
export function savePicture(canvas, done) {
  canvas.toBlob((blob) => done(blob && download(blob, "png")), "image/png");
}

// A film of the canvas, of at most ten minutes. `changed` is called with whether a film is being recorded, and with the
// name of a saved film or null.
export class Film {
  constructor(canvas, changed) {
    Object.assign(this, { canvas, changed, recorder: null });
    this.type = window.MediaRecorder ? TYPES.find((type) => MediaRecorder.isTypeSupported(type)) : undefined;
  }

  get possible() {
    return Boolean(this.type && this.canvas.captureStream);
  }

  toggle() {
    if (this.recorder) {
      this.recorder.stop();
      return;
    }
    const stream = this.canvas.captureStream(30);
    const parts = [];
    this.recorder = new MediaRecorder(stream, { mimeType: this.type, videoBitsPerSecond: 4e6 });
    this.recorder.ondataavailable = ({ data }) => data.size && parts.push(data);
    this.recorder.onstop = () => {
      for (const track of stream.getTracks()) track.stop();
      clearTimeout(this.timer);
      this.recorder = null;
      this.changed(false, download(new Blob(parts, { type: this.type }), this.type.startsWith("video/mp4") ? "mp4" : "webm"));
    };
    this.recorder.start(1000);
    this.timer = setTimeout(() => this.recorder?.stop(), LONGEST_FILM);
    this.changed(true, null);
  }
}
