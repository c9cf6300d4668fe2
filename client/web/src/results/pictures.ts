// Pictures of frames, loaded from their files when they are needed and kept for a while.

/** Of decoded pictures, four bytes a pixel. */
const MOST_BYTES = 192e6;
const LEAST_KEPT = 6;

export type Picture = HTMLImageElement | "missing";

export class Pictures {
  private readonly kept = new Map<string, Promise<Picture>>();
  private readonly ready = new Map<string, Picture>();
  private readonly most: number;

  constructor(width: number, height: number) {
    this.most = Math.max(LEAST_KEPT, Math.floor(MOST_BYTES / (4 * width * height)));
  }

  /** How many frames ahead are worth loading. */
  get ahead(): number {
    return Math.min(12, Math.floor(this.most / 4));
  }

  /** The picture, if it is there already. */
  now(file: string): Picture | null {
    return this.ready.get(file) ?? null;
  }

  /** Load a picture, or say that its file is missing. */
  load(file: string): Promise<Picture> {
    const known = this.kept.get(file);
    if (known) {
      this.kept.delete(file); // the newest comes last
      this.kept.set(file, known);
      return known;
    }
    const image = new Image();
    image.src = file;
    const loading = image.decode().then(
      (): Picture => image,
      (): Picture => "missing",
    );
    this.kept.set(file, loading);
    loading.then((picture) => {
      if (this.kept.has(file)) this.ready.set(file, picture);
    });
    this.forget();
    return loading;
  }

  private forget(): void {
    while (this.kept.size > this.most) {
      const oldest = this.kept.keys().next().value!;
      this.kept.delete(oldest);
      this.ready.delete(oldest);
    }
  }
}
