var a=()=>performance.timeOrigin+performance.now(),r=class extends Error{},n=e=>e instanceof Error?e.message||e.name:String(e);export{a,r as b,n as c};
