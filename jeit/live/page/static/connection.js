// The connection to the session: messages are converted to objects, and a lost connection is opened again.

const OUTSIDE_PIXEL_VALUE = -32768;
const LONGEST_WAIT = 5000;

// Decode a picture from its bytes; the server's wire.py describes their layout.
export function readPicture(bytes) {
  const length = new DataView(bytes).getUint32(0, true);
  const header = JSON.parse(new TextDecoder().decode(new Uint8Array(bytes, 4, length)));
  const values = new Float32Array(bytes, 4 + length, header.channels);
  const picture = { ...header, values, pixels: null };
  if (header.shape) {
    const whole = new Int16Array(bytes, 4 + length + 4 * header.channels, header.shape[0] * header.shape[1]);
    picture.pixels = Float32Array.from(whole, (value) => (value === OUTSIDE_PIXEL_VALUE ? NaN : value * header.scale));
  }
  return picture;
}

// `handle`: functions that are called for each kind of message (scene, state, answer, picture), and when the connection
// is found or lost; `lost` is called with the reason.
export class Connection {
  constructor(handle) {
    this.handle = handle;
    this.wait = 250;
    this.open();
  }

  open() {
    const address = new URL("socket", location.href);
    address.protocol = location.protocol === "https:" ? "wss:" : "ws:";
    address.search = location.search;
    this.socket = new WebSocket(address);
    this.socket.binaryType = "arraybuffer";
    this.socket.onopen = () => {
      this.wait = 250;
      this.handle.found();
    };
    this.socket.onmessage = ({ data }) => {
      if (typeof data !== "string") {
        this.handle.picture(readPicture(data));
        return;
      }
      const message = JSON.parse(data);
      if (message.kind === "state") this.send({ do: "seen" });
      this.handle[message.kind]?.(message);
    };
    this.socket.onclose = ({ reason }) => {
      this.handle.lost(reason || "The session has ended, or cannot be reached; trying again …");
      setTimeout(() => this.open(), this.wait);
      this.wait = Math.min(LONGEST_WAIT, 2 * this.wait);
    };
  }

  send(command) {
    if (this.socket.readyState !== WebSocket.OPEN) return false;
    this.socket.send(JSON.stringify(command));
    return true;
  }
}
