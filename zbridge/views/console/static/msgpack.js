// Reads MessagePack: what fleet messages consist of. Integers beyond 2^53 lose precision; extensions become null.

const MOST_NESTED = 32;
const text = new TextDecoder();

class Reader {
  constructor(bytes) {
    this.bytes = bytes;
    this.view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
    this.at = 0;
  }

  number(read, size) {
    this.at += size;
    return this.view[read](this.at - size);
  }

  size(width) {
    return this.number(["getUint8", "getUint16", "getUint32"][width], 1 << width);
  }

  bin(size) {
    if (this.at + size > this.bytes.length) throw new RangeError("MessagePack ends early");
    this.at += size;
    return this.bytes.subarray(this.at - size, this.at);
  }

  list(size, depth) {
    if (size > this.bytes.length - this.at) throw new RangeError("MessagePack ends early");
    return Array.from({ length: size }, () => this.value(depth + 1));
  }

  map(size, depth) {
    const found = Object.create(null);
    for (let left = size; left > 0; left--) found[this.value(depth + 1)] = this.value(depth + 1);
    return found;
  }

  value(depth = 0) {
    if (depth > MOST_NESTED) throw new RangeError("MessagePack is nested too deeply");
    const type = this.number("getUint8", 1);
    if (type < 0x80) return type;
    if (type < 0x90) return this.map(type & 15, depth);
    if (type < 0xa0) return this.list(type & 15, depth);
    if (type < 0xc0) return text.decode(this.bin(type & 31));
    if (type >= 0xe0) return type - 256;
    if (type >= 0xc4 && type <= 0xc6) return this.bin(this.size(type - 0xc4));
    if (type >= 0xc7 && type <= 0xc9) return this.extension(this.size(type - 0xc7));
    if (type >= 0xcc && type <= 0xce) return this.size(type - 0xcc);
    if (type >= 0xd4 && type <= 0xd8) return this.extension(1 << (type - 0xd4));
    if (type >= 0xd9 && type <= 0xdb) return text.decode(this.bin(this.size(type - 0xd9)));
    if (type === 0xdc || type === 0xdd) return this.list(this.size(type - 0xdb), depth);
    if (type === 0xde || type === 0xdf) return this.map(this.size(type - 0xdd), depth);
    return this.plain(type);
  }

  plain(type) {
    switch (type) {
      case 0xc0: return null;
      case 0xc2: return false;
      case 0xc3: return true;
      case 0xca: return this.number("getFloat32", 4);
      case 0xcb: return this.number("getFloat64", 8);
      case 0xcf: return Number(this.number("getBigUint64", 8));
      case 0xd0: return this.number("getInt8", 1);
      case 0xd1: return this.number("getInt16", 2);
      case 0xd2: return this.number("getInt32", 4);
      case 0xd3: return Number(this.number("getBigInt64", 8));
    }
    throw new RangeError("not MessagePack");
  }

  extension(size) {
    this.bin(size + 1);
    return null;
  }
}

// Returns the value; throws RangeError for bytes that are no MessagePack.
export function unpack(bytes) {
  return new Reader(bytes).value();
}

// Returns the little-endian float32 of a bin: it may begin at any byte.
export function floats(bin) {
  return new Float32Array(bin.slice().buffer, 0, bin.length >> 2);
}
